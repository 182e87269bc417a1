"""The core: scenarios in, verdicts out."""
