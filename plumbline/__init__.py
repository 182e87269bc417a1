"""The core: scenario files enter, verdicts leave."""

__version__ = "0.1.0"
