"""Adapters: one file per engine and formulation, registered in `plumbline.engines.registry`."""
