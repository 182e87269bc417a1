"""What `plumbline.equations` replaced: a comparison for nightly tests, until the replacement is complete."""
