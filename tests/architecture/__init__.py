"""Tests of the import graph and of the documentation of the code."""
