"""Model files (URDF, MJCF): what a file says, and how each engine's importer reads it."""
