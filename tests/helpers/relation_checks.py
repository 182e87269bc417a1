"""Check relations on one engine, with the bounds that a run computes once for all engines."""

from plumbline.measurements import relations, run_relations, state_relations


def check_relations(engine, model, states):
    return relations.check_relations(engine, model, states, relations.relation_bounds(model, states))


def check_state_relations(engine, model, states):
    bounds = state_relations.state_bounds(model, states)
    return state_relations.check_state_relations(engine, model, states, bounds)


def check_run_relations(engine, model, state):
    growth = run_relations.run_growth(model, state)
    return run_relations.check_run_relations(engine, model, state, growth)
