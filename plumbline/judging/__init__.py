"""Judge numbers: raw answers of engines and the truth go in, rows with verdicts come out; no engine runs.

`state`, `step` and `trajectory` compare with the truth, `long_runs` and `relation_rows` need none.
`known_issues` marks expected verdicts, and `outlier` names the engine that differs from all others.  Rows,
verdicts and their display are in `rows`; what is judged comes from `plumbline.measurements`.
"""
