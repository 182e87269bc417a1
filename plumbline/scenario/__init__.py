"""Scenario files: YAML → Scenario."""
