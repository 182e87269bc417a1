"""Rules for adapters: short functions, and a contract that an engine of one body on a ball joint can pass."""

import ast

import pytest

from plumbline.engines.adapter import UNSUPPORTED_KINDS
from plumbline.model.datatypes import Unsupported
from tests.adapters import test_adapter_contract as contract
from tests.helpers import ROOT

MAX_FUNCTION_LINES = 60
ADAPTERS = sorted((ROOT / "adapters").glob("*.py"))


@pytest.mark.parametrize("path", ADAPTERS, ids=lambda path: path.stem)
def test_functions_are_short(path):
    functions = [n for n in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(n, ast.FunctionDef)]
    lengths = {function.name: function.end_lineno - function.lineno + 1 for function in functions}
    assert [name for name, lines in lengths.items() if lines > MAX_FUNCTION_LINES] == []


# -- the contract itself -----------------------------------------------------------------------


REASONS = {
    "rods": "this engine has ball joints only",
    "chains": "this engine has one body only",
    "loads": "this engine has one body on a ball joint only",
    "mass_matrix": "this engine does not compute a mass matrix",
    "rockets": "this engine has no rockets at all",
}


@pytest.fixture
def contract_of(monkeypatch):
    """The contract's test of one name, on MuJoCo restricted to one body on a ball joint."""
    mujoco_engine = pytest.importorskip("adapters.mujoco_engine")

    class OneBall(mujoco_engine.Mujoco):
        name = "one-ball"

        def _evaluate(self, model, states):
            self.refuse_chains_and_rods(model)
            return super()._evaluate(model, states)

        def _simulate(self, model, *more):
            self.refuse_chains_and_rods(model)
            return super()._simulate(model, *more)

        def refuse_chains_and_rods(self, model):
            if model.n > 1 or model.rods.any():
                raise Unsupported("this engine has one body on a ball joint only")

    def run(gaps, test, *args):
        engine = OneBall()
        monkeypatch.setattr(OneBall, "unsupported", {kind: REASONS[kind] for kind in gaps})
        monkeypatch.setattr(
            contract.worker, "call_adapter", lambda _, method, *a: getattr(engine, method)(*a)
        )
        monkeypatch.setattr(contract.worker, "adapter_attribute", lambda _, name: getattr(engine, name))
        contract.declared_gaps.cache_clear()
        getattr(contract, f"test_{test}")(engine.name, *args)

    yield run
    contract.declared_gaps.cache_clear()


@pytest.mark.parametrize("gaps", [("rods", "chains"), ("rods", "chains", "loads")], ids="-".join)
def test_an_engine_of_one_body_on_a_ball_joint_can_pass(contract_of, gaps):
    for kind in gaps:
        contract_of(gaps, "a_declared_gap_is_real", kind)
    for joints in contract.JOINT_PATTERNS:
        for loaded in (False, True):
            contract_of(gaps, "states_obey_newton_and_euler", joints, loaded)
    for hang in ({}, {"joint": 0.4}):
        contract_of(gaps, "hangs_at_rest", hang)
    for joints in ("balls", "rods"):
        contract_of(gaps, "p_and_minus_p_are_the_same_attitude", joints)
        contract_of(gaps, "evaluation_is_deterministic", joints)
    contract_of(gaps, "frames_and_quaternion_order")
    rk4 = next(method for name, method in contract.INTEGRATORS if name == "mujoco" and method.name == "RK4")
    contract_of(gaps, "the_first_sample_is_the_initial_state", rk4)
    contract_of(gaps, "sample_times", rk4)
    contract_of(gaps, "runs_are_deterministic", rk4, "balls")
    contract_of(gaps, "converges_to_the_truth_with_its_declared_order", rk4, "rod")


@pytest.mark.parametrize(
    ("gaps", "test", "args", "message"),
    [
        (("rods",), "states_obey_newton_and_euler", ("balls", False), "refuses a model with balls, chains"),
        (
            ("rods", "chains", "mass_matrix"),
            "a_declared_gap_is_real",
            ("mass_matrix",),
            "returns mass_matrix",
        ),
        (("mass_matrix",), "states_obey_newton_and_euler", ("ball", False), "returns mass_matrix"),
        (("rockets",), "a_declared_gap_is_real", ("rockets",), "rockets is none of joint_reaction"),
    ],
)
def test_a_wrong_declaration_fails(contract_of, gaps, test, args, message):
    with pytest.raises(AssertionError, match=message):
        contract_of(gaps, test, *args)


def test_a_kind_that_is_supported_after_all_must_go(contract_of, monkeypatch):
    monkeypatch.setattr(contract, "JOINT_PATTERNS", {"ball": "b"})
    with pytest.raises(AssertionError, match="refuses no model with loads: take loads out"):
        contract_of(("loads",), "a_declared_gap_is_real", "loads")


def test_every_kind_has_an_explanation():
    assert all(len(words.split()) > 5 for words in UNSUPPORTED_KINDS.values())
