"""Judge numbers: raw answers of engines and the truth go in, rows with verdicts come out.

`state` and `trajectory` compare with the truth, `convergence` finds orders and limits, `long_runs` and
`metamorphic` need no truth.  `known_issues` marks expected verdicts, and `outlier` names the engine that
differs from all others.  Rows, verdicts and their display are in `rows`.
"""
