"""Studies of one scenario: parameter sweeps, and the drift of the reference over long times.

Scenarios go in; tables with one row per cell, or per variant and time, come out as Parquet files.
"""
