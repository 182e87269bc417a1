"""Diagnosis: which term is wrong."""
