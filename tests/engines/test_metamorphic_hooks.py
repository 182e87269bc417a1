"""An adapter without metamorphic hooks gets their defaults; one that has them is used as it is."""

import pytest

from plumbline.engines.adapter import Adapter
from plumbline.engines.metamorphic_hooks import MetamorphicHooks, metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Unsupported
from tests.helpers import pendulums
from tests.helpers.catalogue import catalogue_scenario


class Plain(Adapter):
    """The reference behind the bare contract."""

    name, title, package = "plain", "Plain", "plumbline"
    integrators = ()

    def version(self):
        return "1"

    def _evaluate(self, model, states):
        return load_adapter("reference").evaluate(model, states)


def test_an_adapter_without_hooks_gets_their_defaults():
    engine, model = metamorphic_hooks(Plain()), pendulums.make_model("b")
    assert isinstance(engine, MetamorphicHooks) and engine.name == "plain"
    assert engine.options == engine.linear_solvers == ()
    assert len(engine.evaluate(model, [pendulums.state_from_seed(model)])) == 1
    with pytest.raises(Unsupported, match="welds nothing"):
        engine.with_welded_halves()


def test_an_adapter_with_hooks_stays_itself():
    reference = load_adapter("reference")
    assert metamorphic_hooks(reference) is reference


def test_ways_to_the_accelerations_are_those_of_the_mechanisms_joints():
    mujoco = metamorphic_hooks(load_adapter("mujoco"))
    found = {
        name: mujoco.options_for(catalogue_scenario(name).model)
        for name in ("tumbling-ball", "tumbling-rod", "flyball-governor", "point-mass-arm")
    }
    dense, tendons, held = mujoco.options + tuple(mujoco.joint_options)
    assert found["tumbling-ball"] == (dense,) and found["tumbling-rod"] == (dense, tendons)
    assert found["flyball-governor"] == (dense, tendons, held)
    assert found["point-mass-arm"] == (dense,), "a cylindrical joint would let a point mass spin"
    slider_crank = catalogue_scenario("slider-crank").model
    assert metamorphic_hooks(load_adapter("pinocchio")).options_for(slider_crank) == ()
