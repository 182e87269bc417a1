"""Diagnosis: which single defect would make an engine return what it returned.

Takes a model, the quantities that an engine reported at several states and their truth; returns a sentence
that names the defect, or states that no single change explains the difference.  `defect_model` evaluates a
mechanism with a given defect, `hypotheses` and `output_defects` list them, `fit` and `diagnose` select.
"""
