"""Engines behind one contract: a model and states enter, state quantities and trajectories leave.

`adapter` defines and checks the contract, `registry` lists the engines, `metamorphic_hooks` and `integrators`
are optional parts of adapters, `engine_calls` are the tasks that run in workers, and `environments` provides
other versions of an engine.  Nothing here imports the truth or judges.
"""
