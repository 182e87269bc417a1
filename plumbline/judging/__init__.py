"""Judge numbers: raw answers of engines and the truth go in, rows with verdicts come out; no engine runs.

`state_level`, `step_level` and `trajectory_level` compare with the truth, `long_runs` and `relation_rows`
need none.  `known_issues` marks expected verdicts, and `outlier` names the engine that differs from all
others.  Rows, verdicts and their display are in `rows`; `plumbline.measurements` makes what is judged.
"""
