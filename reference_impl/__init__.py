"""The handwritten notes in NumPy and SciPy; usable alone."""
