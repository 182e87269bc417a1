"""Tests of an engine for its own repository.

    pytest --pyargs plumbline.conformance --plumbline-engine ENGINE

One test per scenario and quantity at state level. `plumbline-known.toml` of the current folder lists expected
failures with their reasons, as `"state/chain-50-balls/*acceleration" = "why"`; one that passes fails.
"""
