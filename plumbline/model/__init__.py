"""The model and its kinematics: data, no physics of an engine."""
