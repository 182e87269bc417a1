"""An adapter without metamorphic hooks gets their defaults; one that has them is used as it is."""

import pytest

from plumbline.engines.adapter import Adapter
from plumbline.engines.metamorphic_hooks import MetamorphicHooks, metamorphic_hooks
from plumbline.engines.registry import load_adapter
from plumbline.model.datatypes import Unsupported
from tests.helpers import pendulums


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
