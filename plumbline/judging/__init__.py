"""Judging: numbers → verdicts."""
