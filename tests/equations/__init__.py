"""Tests of the equations of motion."""
