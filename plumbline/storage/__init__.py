"""Storage: results as Parquet and JSON; history over nights."""
