"""The tests; a package, so that worker processes find its helpers by name."""
