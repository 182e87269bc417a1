"""Worker processes: no physics."""
