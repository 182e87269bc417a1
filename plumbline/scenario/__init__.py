"""Scenario files: YAML text enters, a checked `Scenario` (model, initial state, sample times) leaves.

`yaml_source` parses the text and keeps the position of every value, `schema` declares the fields and their
limits, `validation_messages` turns what the schema refuses into problems with line and column (`errors`),
`loader` builds the model and the initial state.  `generator` makes random scenarios, `field_docs` the
reference page of the fields.
"""
