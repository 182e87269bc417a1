"""Tests of truth."""
