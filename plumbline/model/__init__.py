"""The data that packages exchange, and kinematics without any physics of an engine.

`datatypes` has the model, the state, the quantities of a state and the trajectory; `kinematics` completes
minimal coordinates to states, `sampling` draws random ones, `invariants` computes energies, momenta, joint
gaps and errors between two runs, `welding` splits bodies into welded halves.
"""
