"""Tests of reference_impl."""
