"""Engines: the adapter contract, the registry, the calls made in workers, other versions."""
