"""Long runs: what is conserved is judged by its fall from step to step, and planted leaks are seen."""

from dataclasses import replace

import numpy as np
import pytest

from plumbline.engines.no_answer import NoAnswer
from plumbline.engines.registry import load_adapter
from plumbline.execution.plan import Plan
from plumbline.execution.runner import run_plan
from plumbline.judging.long_runs import judge_long_runs
from plumbline.judging.rows import RowContext
from plumbline.measurements import long_run_study
from plumbline.measurements.drift_order import BLOCK_COUNT, DriftOrder, DriftWindow, InvariantDrift, LongRun
from plumbline.measurements.long_run_study import (
    MAX_BODY_STEPS,
    LongRunPlan,
    leaves_range,
    plan_long_run,
    run_long_run_study,
)
from plumbline.model.datatypes import Integrator, State, Trajectory
from plumbline.model.kinematics import angular_velocity, complete_state, normalised
from plumbline.processes.worker_pool import Limits
from plumbline.scenario.generator import random_motion
from plumbline.scenario.loader import load_scenario
from tests.helpers import engine_process as worker
from tests.helpers.catalogue import catalogue_scenario
from tests.helpers.nightly_tests import slow
from tests.helpers.planted_defects import MOTION_DEFECTS
from tests.helpers.planting import Defect, number_change, plant, rows_reordered, sample_change

DEFECTS = {d.name: d for d in MOTION_DEFECTS}


def run_long(name, engine, integrator, seconds=100.0):
    """Rows by quantity of one integrator's long runs of a scenario."""
    s, chosen = catalogue_scenario(name), load_adapter(engine) if isinstance(engine, str) else engine
    method = chosen.integrator(integrator)
    plan = plan_long_run(method, s.model.n, seconds, s.sample_interval, s.duration)
    study = run_long_run_study(chosen.name, integrator, s.model, s.state, s.sample_interval, plan)
    context = RowContext(name, s.family, chosen.name, chosen.title, "1")
    return {
        row.quantity: row
        for row in judge_long_runs(context, s.model, method, s.closed_form is not None, study).rows
    }


def all_agree(rows):
    return {row.verdict for row in rows.values()} == {"agrees"}


@pytest.fixture
def use_defect(monkeypatch):
    """``use_defect(defect)``: MuJoCo with it, as the engine that `endure` gets."""

    def put(defect):
        engine = plant(defect)
        monkeypatch.setattr(long_run_study, "load_adapter", lambda _: engine)
        return engine

    return put


def test_a_chaotic_motion_keeps_what_is_conserved_for_100_s():
    rows = run_long("double-tumbling-balls", "mujoco", "RK4")
    assert all_agree(rows) and len(rows) == 5
    energy = rows["energy_drift_long"]
    assert energy.level == "invariants" and energy.compared_until == 100.0 and energy.declared_order == 4
    assert 3.5 < energy.order < 5.5
    assert energy.reason.endswith("over steps 0.0078125 … 0.00195312")  # three runs
    by = [energy.extra[f"by {t:g} s"] for t in (0.1, 1, 10, 100)]
    assert by == sorted(by) and by[-1] == energy.value < 1e-5
    norm = rows["norm_drift_long"]
    assert norm.reason.startswith(f"norm drift {norm.value:.2g} within 100 s")  # no unit


def test_a_step_too_coarse_for_100_s_is_judged_where_it_is_not():
    rows = run_long("tumbling-ball", "mujoco", "Euler")
    energy = rows["energy_drift_long"]
    assert energy.verdict == "agrees" and energy.compared_until == 10.0 and abs(energy.order - 1) < 0.2
    assert "within 100 s, which does not decide" in energy.reason
    assert energy.extra["by 100 s"] > 3.0 > energy.extra["scale"] / 2


def test_runs_whose_steps_add_up_to_other_ends_have_the_same_windows():
    """Steps of 0.002 … 0.0005 s, whose sums are rounded."""
    energy = run_long("double-loaded-rods", "mujoco", "Euler", 4.0)["energy_drift_long"]
    assert energy.verdict == "agrees" and energy.compared_until == 4.0


def test_two_steps_below_one_that_is_too_coarse_cannot_disagree():
    """The drift of a rod driven to 100 rad/s falls with order 1.6 to 2⁻⁹ s, with 5 and more from there."""
    energy = run_long("driven-rod", "mujoco", "RK4")["energy_drift_long"]
    assert energy.verdict == "agrees" and energy.compared_until == 10.0 and energy.order > 3.5
    assert "1.1 J within 100 s, which does not decide" in energy.reason


SMALL_DRAG_DEFECT = Defect("damping-1e-7", inputs=number_change("drag_moment", ..., by=1e-7))  # fmt: skip


def restart_halfway(count):
    """Rows whose second half begins again."""
    half = count // 2
    return [*range(half), *range(count - half)]


OPENING_JOINTS = sample_change(lambda run: {"r": run.r + 1e-9 * run.t[:, None, None]})  # by 1e-9 m/s


@pytest.mark.parametrize(
    ("defect", "verdict", "quantities"),
    [
        (SMALL_DRAG_DEFECT, "disagrees", {"energy_drift_long"}),
        (Defect("creep", run=OPENING_JOINTS), "disagrees", {"joint_gap_long"}),
        (Defect("reset", run=rows_reordered(restart_halfway)), "failed", {"all_long"}),
        (DEFECTS["norm-1e-9"], "disagrees", {"norm_drift_long"}),
    ],
    ids=lambda x: x.name if isinstance(x, Defect) else None,
)
def test_planted_leaks_are_seen(use_defect, defect, verdict, quantities):
    rows = run_long("tumbling-ball", use_defect(defect), "RK4", 25.0)
    assert {q for q, row in rows.items() if row.verdict == verdict} >= quantities


def kicked(factor):
    """Runs whose rates are multiplied once, at 4 s, and which go on from there."""

    def alter(simulate, model, state, times, *how):
        number = int(np.searchsorted(times, 4.0))
        if number >= len(times) - 1:
            return simulate(model, state, times, *how)
        before = simulate(model, state, times[: number + 1], *how)
        rates = factor * angular_velocity(before.p[-1], before.pdot[-1])
        kick = complete_state(model, State(normalised(before.p[-1]), rates))
        after = simulate(model, kick, times[number:] - times[number], *how)
        joined = {
            name: np.concatenate([getattr(before, name), getattr(after, name)[1:]])
            for name in ("r", "p", "v", "pdot")
        }
        return Trajectory(times, **joined, steps=before.steps + after.steps)

    return alter


@pytest.mark.parametrize("factor", [1.02, 1.5], ids=["in-range", "out-of-range"])
def test_what_one_kick_adds_at_every_step_is_no_matter_of_too_long_a_time(use_defect, factor):
    rows = run_long("tumbling-ball", use_defect(Defect("kick", run=kicked(factor))), "RK4", 20.0)
    for name in ("energy_drift_long", "momentum_drift_long"):
        assert rows[name].verdict == "unresolved" and rows[name].compared_until == 20.0


def test_another_order_than_its_name_is_seen(use_defect):
    rows = run_long("tumbling-ball", use_defect(DEFECTS["order-2-named-RK4"]), "RK4", 12.5)
    row = rows["energy_drift_long"]
    assert row.verdict == "disagrees" and row.order < 3.5 and "required 3.9" in row.reason
    assert "0.0078125 … 0.000976562" in row.reason  # a fourth run confirms it


@pytest.mark.full
def test_a_symmetric_method_is_bounded_and_a_leak_is_not():
    rows = worker.run_in_engine_process("exudyn", run_long, "spherical", "exudyn", "trapezoidal", 50.0)
    growth = rows["energy_drift_long_growth"]
    assert growth.verdict == "agrees" and growth.value < 0.1 and "bounded" in growth.reason
    assert rows["energy_drift_long"].verdict == "agrees"
    damped = worker.run_in_engine_process("exudyn", growth_row_with_drag)
    assert damped.verdict == "disagrees" and damped.value > 0.9 and "grows with time" in damped.reason


def growth_row_with_drag():
    """The row on the growth of Exudyn's energy with a drag that takes as much as the steps' error."""
    engine = plant(Defect("", engine="exudyn", inputs=number_change("drag_moment", ..., by=3e-6)))
    before, long_run_study.load_adapter = long_run_study.load_adapter, lambda _: engine
    try:
        return run_long("spherical", engine, "trapezoidal", 50.0)["energy_drift_long_growth"]
    finally:
        long_run_study.load_adapter = before


@pytest.mark.full
def test_step_control_keeps_each_invariant_within_its_tolerance():
    rows = worker.run_in_engine_process("pinocchio", run_long, "tumbling-ball", "pinocchio", "dop853", 50.0)
    assert all_agree(rows)
    assert "the error that the tolerance 1e-08 accepts in every step" in rows["energy_drift_long"].reason


def test_a_mechanism_with_a_loop_keeps_what_is_conserved():
    rows = run_long("slider-crank", "mujoco", "RK4", 2.0)
    assert all_agree(rows) and len(rows) == 4
    assert rows["energy_drift_long"].compared_until == 2.0


def test_a_limit_of_softer_runs_is_not_surer_than_they_are_of_it():
    """A limit of attitudes is not of length 1 once the runs part: by 1e-10 on this helical joint."""
    rows = run_long("sprung-helical", "mujoco", "RK4", 12.5)
    assert all_agree(rows) and len(rows) == 4
    norm = rows["norm_drift_long"]
    assert norm.value > 1e-11 and "the limit of softer runs, ±" in norm.reason


@slow
def test_runs_end_before_a_singular_pose():
    """By the closed form the bars lie flat at 0.7144 s."""
    rows = run_long("four-bars-2", "mujoco", "RK4", 2.0)
    singular = rows.pop("singular_pose")
    assert singular.verdict == "unresolved" and singular.compared_until == 0.6875
    assert "from t = 0.7129 s on" in singular.reason and "compared up to t = 0.6875 s" in singular.reason
    assert all_agree(rows)
    assert {row.compared_until for row in rows.values()} == {0.6875}


def test_the_steps_of_an_implicit_method_were_why_its_run_stopped():
    """Newton's iteration in Exudyn converges to about 21 s with steps of 2⁻⁸ s, to 44 s with half of that."""
    s, method = catalogue_scenario("furuta"), load_adapter("exudyn").integrator("generalized-alpha")
    plan = LongRunPlan(24.0, (2.0**-7, 2.0**-8), 24.0)
    study = run_long_run_study("exudyn", method.name, s.model, s.state, s.sample_interval, plan)
    assert [run.failure is None for run in study.runs] == [False, False, True]
    assert study.runs[-1].reached_time == 24.0 and study.plan == plan


@pytest.mark.parametrize(
    ("longest_step", "verdicts"), [(2.0**-11, {"agrees"}), (2.0**-12, {"failed"})], ids=["steps", "engine"]
)
def test_shorter_steps_show_whether_the_steps_were_why_a_run_stopped(monkeypatch, longest_step, verdicts):
    class Stops(type(load_adapter("mujoco"))):
        def _simulate(self, model, state, times, integrator, resolution):
            if times[-1] > 1.0 and resolution > longest_step:
                raise RuntimeError("it stops")
            return super()._simulate(model, state, times, integrator, resolution)

    monkeypatch.setattr(long_run_study, "load_adapter", lambda _: Stops())
    rows = run_long("tumbling-ball", Stops(), "RK4", 4.0)
    assert {row.verdict for row in rows.values()} == verdicts
    if verdicts == {"failed"}:
        assert "it stops" in rows["all_long"].reason
    else:
        assert {row.compared_until for row in rows.values()} == {4.0}


def test_long_runs_end_where_the_motion_is_too_fast_for_every_step():
    """The bob falls free for 0.4515 s; then the cart, a millionth of its mass, is thrown aside."""
    rows = run_long("light-cart-pole", "pinocchio", "rkmk4", 2.0)
    assert all_agree(rows)
    assert {row.compared_until for row in rows.values()} == {0.375}
    for row in rows.values():
        assert row.derivation.endswith("resolve 0.375 s of 2 s, then the motion is too fast")


def test_a_body_that_is_kilometres_away_is_solved_as_its_rounding_allows(tmp_path):
    text = catalogue_scenario("slider-on-arm").path.read_text()
    file = tmp_path / "far.yaml"
    file.write_text(text.replace("rates: [1.4]", "rates: [1000.0]"))
    s, method = load_scenario(file), load_adapter("exudyn").integrator("generalized-alpha")
    plan = LongRunPlan(16.0, (2.0**-9,), 16.0)
    study = run_long_run_study("exudyn", method.name, s.model, s.state, s.sample_interval, plan)
    (run,) = study.runs
    context = RowContext("far", s.family, "exudyn", "Exudyn", "1")
    for row in judge_long_runs(context, s.model, method, False, study).rows:
        assert row.derivation.endswith("; steps solved to 1e-11")
    assert run.failure is None and run.solver_rtol == 10 * method.solver_rtol
    quantity, end = "momentum_drift", 16.0
    floors = [
        InvariantDrift([one], method, quantity, end).rounding_floor()
        for one in (run, replace(run, solver_rtol=0.0))
    ]
    assert floors[0] > 2 * floors[1]


@slow
def test_a_whip_is_solved_as_the_rounding_of_its_accelerations_allows():
    """At 0.2 s three bodies reach 1,600 m/s² in a whip, where Newton's iteration stops at 1e-12."""
    s, method = random_motion(6, 6), load_adapter("exudyn").integrator("generalized-alpha")
    times, step = np.array([0.0, 7 / 32]), 2.0**-15
    run = worker.call_adapter("exudyn", "simulate", s.model, s.state, times, method.name, step)
    assert run.steps == times[-1] / step
    assert 10 * method.solver_rtol <= run.solver_rtol <= 1e-10


# --- lengths, and the statistic -----------------------------------------------------------------


def test_the_affordable_length_is_reported():
    rk4 = Integrator("RK4", "step", 4)
    assert plan_long_run(rk4, 1, 100.0) == LongRunPlan(100.0, (2.0**-7, 2.0**-8, 2.0**-9), 100.0)
    for n in range(1, 60):
        plan = plan_long_run(rk4, n, 100.0)
        assert n * plan.seconds / plan.resolutions[-1] <= MAX_BODY_STEPS[4]
        assert plan.shortening_note == (
            "" if n < 3 else f"; the limit of steps × bodies allows {plan.seconds:g} s of 100 s"
        )
    assert plan_long_run(Integrator("d", "tolerance", 8), 10, 100.0).seconds == 6.25


def test_steps_lengths_and_windows_are_in_proportion_to_a_motion_of_milliseconds():
    """Samples of 2⁻¹¹ s, closer than steps of 2⁻⁷ s, in a motion of 2⁻⁵ s; others are not closer."""
    for method in (Integrator("RK4", "step", 4), Integrator("d", "tolerance", 8)):
        usual = plan_long_run(method, 7, 100.0)
        fast = plan_long_run(method, 7, 100.0, 2.0**-11, 2.0**-5)
        assert usual.time_unit == 1.0 and fast.time_unit == 2.0**-5 and fast.seconds == usual.seconds / 32
    assert plan_long_run(method, 7, 100.0, 2.0**-7, 2.0**-5).time_unit == 1.0
    rk4 = plan_long_run(Integrator("RK4", "step", 4), 7, 100.0, 2.0**-11, 2.0**-5)
    assert rk4.resolutions == (2.0**-12, 2.0**-13, 2.0**-14)
    assert long_run_study._window_ends(rk4.seconds, rk4) == [0.1 / 32, 1 / 32, 10 / 32, rk4.seconds]


def test_a_drift_that_grows_as_a_power_of_time_leaves_its_range_earlier():
    def run(*drifts):
        windows = {t: DriftWindow(d, d, np.array([d])) for t, d in zip((0.1, 1.0), drifts, strict=True)}
        scales = {t: {"energy_drift": 1.0} for t in windows}
        return LongRun(
            0.01, 100, 1.0, NoAnswer("it failed", False), {}, scales, {"energy_drift": windows}, 0.0
        )

    assert not leaves_range(run(5e-4, 5e-3), 10.0)  # linear: 0.05 of its scale by 10 s
    assert leaves_range(run(5e-5, 5e-3), 10.0)  # quadratic: 0.5
    assert leaves_range(run(5e-2, 5e-2), 10.0)  # at least linear: 0.5
    assert not leaves_range(run(0.0, 5e-3), 10.0)


def test_a_fourth_run_decides_where_two_runs_drift_too_far():
    """As where joints open at a violent moment and stay open, which is no matter of the step."""
    blocks = np.random.default_rng(3).uniform(1.0, 2.0, BLOCK_COUNT) * 1e-3
    method = Integrator("trapezoidal", "step", 2)

    def falls_too_slowly(*factors):
        runs = []
        for k, factor in enumerate(factors):
            drift = DriftWindow(1.0, 1.0, blocks * factor)
            windows, scales = {"momentum_drift": {25.0: drift}}, {25.0: {"momentum_drift": 100.0}}
            uncertainty = {25.0: {"momentum_drift": 0.0}}
            runs.append(LongRun(2.0**-k, 25 * 2**k, 25.0, None, uncertainty, scales, windows, 0.0))
        return InvariantDrift(runs, method, "momentum_drift", 25.0).falls_too_slowly

    assert not falls_too_slowly(1, 1 / 4, 1 / 16)
    assert falls_too_slowly(1, 1.5 / 4, 2.5 / 16)
    assert not falls_too_slowly(1, 1.5 / 4, 2.5 / 16, 1 / 64)
    assert falls_too_slowly(1, 1.5 / 4, 2.5 / 16, 2.5 / 32)


def test_the_jackknife_knows_a_common_motion_from_two():
    rng = np.random.default_rng(7)
    blocks = rng.exponential(size=BLOCK_COUNT)
    same = DriftOrder.from_blocks(blocks, blocks / 16, 2)
    assert abs(same.order - 2) < 1e-12 and same.order_error < 1e-12
    # two motions with the same law: as many orders off by more than 3 σ as so few blocks explain
    falls = [DriftOrder.from_blocks(*rng.exponential(size=(2, BLOCK_COUNT)), 2) for _ in range(2000)]
    wrong = np.mean([abs(f.order) > 3 * f.order_error for f in falls])
    assert wrong < 0.02
    # one block that alone moves shows nothing
    lone = np.zeros(BLOCK_COUNT)
    lone[3] = 1.0
    assert not np.isfinite(DriftOrder.from_blocks(lone, lone / 4, 2).order_error)


def test_a_run_has_long_cells_beside_the_others():
    plan = Plan(
        [catalogue_scenario("conical")], ["mujoco"], "trajectory", limits=Limits(120), long_run_seconds=6.25
    )
    seen = []
    result = run_plan(plan, lambda done, total, what: seen.append((done, total)))
    assert seen[-1] == (9, 9)  # the truth, four refinement studies, four long runs
    rows = [row for row in result.rows if row.quantity.endswith("_long")]
    assert len(rows) == 4 * 5 and {row.level for row in rows} == {"invariants"}
    assert len({row.key for row in result.rows}) == len(result.rows)
    alias = [row for row in rows if row.integrator == "implicitfast"]
    assert {row.verdict for row in alias} == {"information"} and {row.alias_of for row in alias} == {"Euler"}
    assert all("implicitfast is Euler here: " in row.reason for row in alias)
    assert {row.verdict for row in rows if row not in alias} == {"agrees"}
