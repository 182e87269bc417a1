"""Why an engine differs from the truth, as records of causes.

`edits` lists wrong numbers, `readings` what may be read in another frame, `terms` what is linear in the
equations, `outputs` what may be returned in place of a quantity.  `prediction` evaluates many of them at
once, `fit` finds amounts, `diagnose` selects; `integrator_search` does the same for steps.  `cause` makes
sentences.
"""
