"""Studies: parameter sweeps, drift of the reference over long times, coverage, the search of versions.

Of sweeps and drift, tables with one row per cell, or per variant and time, come out as Parquet files.
"""
