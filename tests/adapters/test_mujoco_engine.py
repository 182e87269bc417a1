"""What MuJoCo alone must show: flat bodies, its way of blowing up, equalities in place of joints."""

from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from plumbline.measurements.state_relations import QUANTITIES
from plumbline.model import kinematics
from plumbline.model.datatypes import EngineFailure, State, Unsupported
from plumbline.model.equivalent import rotate_body_frames
from plumbline.model.kinematics import complete_state, rotation_matrix
from plumbline.model.random_mechanisms import ELEMENTS, random_loop_mechanism
from plumbline.model.sampling import random_states
from plumbline.studies.random_steps import mechanism_of
from plumbline.truth.certified_state import certify_state
from plumbline.truth.rounding_bound import state_rounding_bound
from tests.helpers import engine_process as worker
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario

pytest.importorskip("mujoco")

import mujoco

from adapters.mujoco_engine import STEP_REGULARISATIONS, Mujoco, _Tie
from adapters.mujoco_variants import MAX_LEFT
from tests.helpers.random_chains import tree_from_seed


def simulate(subject, at, integrator, step, times):
    return worker.call_adapter("mujoco", "simulate", subject, at, times, integrator, step)


def test_flat_bodies_and_points_on_the_joint():
    """A lamina (J_x + J_y = J_z to the last bit), a pivot at the centre of mass, a mass of a microgram."""
    subject = pendulums.make_model("rb")
    at = pendulums.state_from_seed(subject, rate=1.0)
    J = np.array([np.diag([0.01, 0.02, 0.03]), np.diag([1e-11, 2e-11, 2e-11])])
    subject = subject.changed(
        inertia=J, mass=np.array([1.0, 1e-9]), proximal=np.array([[0, 0, 0.0], [0.1, 0, 0]])
    )
    at = kinematics.complete_state(subject, State(at.p, at.omega, at.u, at.udot))
    (got,) = worker.call_adapter("mujoco", "evaluate", subject, [at])
    true = certify_state(subject, at).quantities
    np.testing.assert_allclose(got.acceleration, true.acceleration, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(got.joint_reaction[1], true.joint_reaction[1], rtol=1e-8, atol=1e-18)


def test_a_step_too_coarse_is_a_failure_with_a_sentence(tmp_path):
    """No autoreset, no finite-looking row, and no log file in the working directory."""
    subject, at = pendulums.make_model("rr"), pendulums.state_from_seed(pendulums.make_model("rr"), rate=10.0)
    before = worker.run_in_engine_process("mujoco", Path.cwd)
    with pytest.raises(EngineFailure, match=r"MuJoCo warned by t = .* huge value"):
        simulate(subject, at, "Euler", 0.5, np.arange(41) * 0.5)
    assert not (before / "MUJOCO_LOG.TXT").exists()


def evaluate_by(name, model, state):
    variant = next(one for one in Mujoco.variants if one.names == (name,))
    return Mujoco().with_variant(variant).evaluate(model, [state])


def test_an_iteration_that_has_not_converged_is_refused():
    """Turned, the planar four-bar's redundant rows agree to rounding only, by which PGS converges slowly."""
    scenario = catalogue_scenario("four-bar")
    asked = "mujoco", evaluate_by, "mjtSolver.mjSOL_PGS"
    (found,) = worker.run_in_engine_process(*asked, scenario.model, scenario.state)
    assert found.limit_error["acceleration"] < MAX_LEFT * np.max(np.abs(found.acceleration))
    turned = rotate_body_frames(scenario.model, scenario.state, np.array([0.1, 0.5, -0.7, 0.5]))
    with pytest.raises(Unsupported, match="has not converged after 400000 iterations"):
        worker.run_in_engine_process(*asked, *turned)


def at_rest(model, state):
    names = ("omega", "udot", "v", "xdot")
    return complete_state(model, replace(state, **{name: 0 * getattr(state, name) for name in names}))


def worst_ratio(model, state, option):
    """The largest difference of an option's answers from the usual ones, in their tolerances."""
    (usual,), (other,) = (one.evaluate(model, [state]) for one in (Mujoco(), Mujoco().with_option(option)))
    bound, ratios = state_rounding_bound(model, state), []
    for name in QUANTITIES:
        if (value := getattr(usual, name)) is None:
            continue
        allowed = bound.tolerance(name) + sum((x.limit_error or {}).get(name, 0.0) for x in (usual, other))
        off = np.linalg.norm(np.atleast_1d(value - getattr(other, name)), axis=-1)
        ratios.append(np.max(off / np.maximum(allowed, np.finfo(float).tiny)))
    return max(ratios)


OTHER_JOINTS = {  # what closes a loop, and the joints of the tree
    "tendon equalities": (["rod"], ("rod", "ball", "hinge")),
    "joint equalities": (["hinge"], ("hinge", "slide", "universal")),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("option", OTHER_JOINTS)
def test_equalities_in_place_of_joints_give_the_same_answers(option, seed):
    """Trees and loops; tendons at rest only, since MuJoCo leaves out a term of their acceleration."""
    loop, state = random_loop_mechanism(seed, 4, *OTHER_JOINTS[option])
    tree = tree_from_seed(seed, 5, OTHER_JOINTS[option][1], elements=ELEMENTS)
    for model, at in ((loop, state), (tree, *random_states(tree, 1, seed))):
        at = at_rest(model, at) if option == "tendon equalities" else at
        assert worst_ratio(model, at, option) <= 1


def test_bodies_that_come_in_another_order_without_rods_keep_their_masses():
    scenario = catalogue_scenario("tree-of-seven")
    assert worst_ratio(scenario.model, at_rest(scenario.model, scenario.state), "tendon equalities") <= 1


def test_a_tendon_at_a_wrong_point_is_seen():
    def moved(bodies, points, length, softness):
        return _Tie(bodies, points + 1e-7, length, softness)

    model, state = random_loop_mechanism(0, 4, ["rod"], ("ball",))
    with patch("adapters.mujoco_engine._Tie", moved):
        assert worst_ratio(model, at_rest(model, state), "tendon equalities") > 1


def test_tendon_equalities_leave_out_the_terms_of_velocities():
    """The length ℓ of a rod has ℓ̈ = 0: J q̈ + J̇ q̇ of its end; MuJoCo's tendon has J q̈ = 0.

    When this fails MuJoCo has the term: known_issues.yaml must end with the version before.
    """
    model = pendulums.make_model("r")
    state = pendulums.state_from_seed(model, 1)
    A = rotation_matrix(state.p[0])
    arm, spin = A @ model.proximal[0], A @ state.omega[0]
    carried = np.cross(spin, np.cross(spin, arm)) @ state.u[0] + model.length[0] * np.sum(state.udot[0] ** 2)
    assert abs(carried) > 0.1
    for engine, left_out in ((Mujoco(), 0.0), (Mujoco().with_option("tendon equalities"), carried)):
        (found,) = engine.evaluate(model, [state])
        end = found.acceleration[0] + np.cross(A @ found.angular_acceleration[0], arm)
        assert end @ state.u[0] == pytest.approx(left_out - carried, abs=1e-10)


def test_the_installed_version_has_the_names_of_all_variants_and_of_the_column():
    calls = [variant.names for variant in Mujoco.variants] + [call for call, _ in Mujoco.column_names]
    for name in {name for call in calls for name in call}:
        assert attrgetter(name)(mujoco) is not None


def test_every_step_of_a_loop_has_the_second_iteration_that_removes_rounding():
    model, state = mechanism_of(70013)
    soft = Mujoco()._softened(model, STEP_REGULARISATIONS[0])[0]
    integrator = next(one for one in Mujoco.integrators if one.name == "implicitfast")
    soft.tree.prepare(soft.state(state), integrator, 1 / 300)
    for _ in range(20):
        mujoco.mj_step(soft.tree.m, soft.tree.d)
        assert soft.tree.d.solver_niter[0] >= 2
