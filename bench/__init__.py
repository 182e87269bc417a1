"""Benchmarks: `make bench` runs them; every figure is a ratio of CPU times within one run."""
