"""Robots of public packages through every importer; the page docs/importers.md."""
