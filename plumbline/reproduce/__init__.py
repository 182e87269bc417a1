"""Stand-alone reproduction scripts."""
