"""Run engines and return numbers, without verdicts: repeated runs, single steps, relations, long runs.

`order_and_limit` has the observed order and the extrapolated limit of a refinement study.
"""
