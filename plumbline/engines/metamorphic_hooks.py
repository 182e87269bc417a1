"""Hooks for metamorphic tests: other ways of one engine to the same answers.

An adapter that subclasses `MetamorphicHooks` instead of `Adapter` may offer other algorithms for the
accelerations, other linear solvers, bodies built of two welded halves, and runs that turn round.
All are optional; an adapter without them is still tested with rotated, rescaled and reversed models.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import ClassVar, Self

import numpy as np

from plumbline.engines.adapter import Adapter, check_samples, check_state
from plumbline.model.datatypes import Integrator, Kind, Model, State, Trajectory, Unsupported
from plumbline.model.welding import BodyParts, split_bodies, undivided_bodies


class MetamorphicHooks(Adapter):
    """An adapter whose engine has several ways to the same answers.

    ``_evaluate`` and ``_simulate`` use the way named by ``option`` (empty: the usual one), and
    ``_evaluate`` builds each body of the parts that `body_pieces` returns.
    """

    options: ClassVar[tuple[str, ...]] = ()  # other algorithms for the accelerations
    loop_options: ClassVar[tuple[str, ...]] = ()  # those of them that mechanisms with loops have too
    joint_options: ClassVar[Mapping[str, tuple[Kind, ...]]] = {}  # other ways to build joints of some kinds
    # those of them with the same motions: the integrators, by name, whose steps do not depend on the way
    motion_options: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    unmoved_options: ClassVar[Mapping[str, str]] = {}  # those whose motions are not compared: why
    usual_linear_solver: ClassVar[str] = ""  # of implicit steps, or of the equations of motion
    linear_solvers: ClassVar[tuple[str, ...]] = ()  # the others
    unwritten_ways: ClassVar[tuple[str, ...]] = ()  # those that its scripts cannot show
    welding_unsupported_reason: ClassVar[str] = "the adapter welds nothing"  # empty where it does
    option: str = ""  # the one of `options`, `joint_options` or `linear_solvers` in use
    has_welded_halves: bool = False  # whether `body_pieces` divides every body

    @property
    def ways(self) -> tuple[str, ...]:
        """All that `with_option` takes."""
        return *self.options, *self.joint_options, *self.linear_solvers

    def with_option(self, option: str) -> Self:
        """Copy the adapter, set to another algorithm or linear solver.

        Args:
            option: one of `ways`.

        Raises:
            KeyError: the engine has no such option; the message lists those it has.

        """
        if option not in self.ways:
            raise KeyError(f"{self.name} has no option {option!r}; it has {list(self.ways)}")
        other = copy(self)
        other.option = option
        return other

    def options_for(self, model: Model) -> tuple[str, ...]:
        """List the ways to the accelerations of a mechanism.

        Returns:
            All `options` (with loops `loop_options`), and those of `joint_options` whose joints it has; of
            these none where bodies without inertia need their joints.

        """
        usual = self.loop_options if model.has_loops else self.options
        if model.lacks_inertia:
            return usual
        ways = (way for way, kinds in self.joint_options.items() if not set(kinds).isdisjoint(model.kind))
        return (*usual, *ways)

    def with_welded_halves(self) -> Self:
        """Copy the adapter, set to build every body of two welded halves.

        Raises:
            Unsupported: the engine cannot weld; the message is `welding_unsupported_reason`.

        """
        if self.welding_unsupported_reason:
            raise Unsupported(self.welding_unsupported_reason, "welded halves")
        other = copy(self)
        other.has_welded_halves = True
        return other

    def body_pieces(self, model: Model) -> BodyParts:
        """Divide the bodies of a model into the parts that the engine is to weld.

        Returns:
            Per body one part, or two where the adapter is set to welded halves.

        """
        return split_bodies(model) if self.has_welded_halves else undivided_bodies(model)

    def simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: str, resolution: float
    ) -> Trajectory:
        """Simulate to ``end``, reverse all that the integrator carries, and simulate back.

        The last row of a symmetric integrator is the first one with opposite rates, but for rounding
        and the tolerance of the step's solver.  Errors are those of `Adapter.evaluate`.

        Args:
            model: the pendulum, without drag.
            end: duration one way [s].
            resolution: step [s], or relative tolerance, by the integrator's ``kind``.

        Returns:
            Rows at 0, ``end`` and 2 ``end``.

        """
        self._check_motion(model)
        check_state(model, state)
        run = self._simulate_round_trip(model, state, end, self.integrator(integrator), resolution)
        check_samples(
            model, np.array([0.0, end, 2 * end]), run, f"{self.name}._simulate_round_trip, {integrator}"
        )
        return run

    def _simulate_round_trip(
        self, model: Model, state: State, end: float, integrator: Integrator, resolution: float
    ) -> Trajectory:
        """Simulate there and back; rows at 0, ``end`` and 2 ``end``."""
        raise Unsupported(f"the adapter does not turn a run of {integrator.name} round")


def metamorphic_hooks(adapter: Adapter) -> MetamorphicHooks:
    """Return an adapter with the hooks, whether or not its engine has other ways.

    Args:
        adapter: any adapter.

    Returns:
        The adapter itself where it has the hooks; else the same engine with every hook at its default.

    """
    if isinstance(adapter, MetamorphicHooks):
        return adapter
    with_hooks: type[MetamorphicHooks] = type("WithHooks", (type(adapter), MetamorphicHooks), {})
    return with_hooks()
