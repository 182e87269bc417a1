"""Model files: read, run, judge, cause, certified, script, shrink (`plumbline model`)."""
