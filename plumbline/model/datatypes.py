"""The data that packages exchange: small frozen dataclasses of NumPy arrays.

`Model`, the mechanism, is the reference's `Mechanism` under the name that scenarios and engines use.

Frames and units, everywhere: SI; world z up, pivot at the world origin; ``r`` is a centre of mass in the
world frame; quaternions are scalar first and turn body vectors into world vectors; ``omega`` is the angular
velocity in the body frame (the notes' ω′ = 2 L(p) ṗ). N is the number of bodies, T the number of samples.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

import numpy as np

from plumbline.model.step_methods import StepMethod
from plumbline.processes.exceptions import PlumblineError
from reference_impl.arrays import AnyArray as AnyArray
from reference_impl.arrays import Array as Array
from reference_impl.arrays import Bool as Bool
from reference_impl.arrays import Flags as Flags
from reference_impl.arrays import Float as Float
from reference_impl.arrays import Indices as Indices
from reference_impl.arrays import Int as Int
from reference_impl.arrays import Shaped as Shaped
from reference_impl.joint_kinds import BALL as BALL
from reference_impl.joint_kinds import CYLINDRICAL as CYLINDRICAL
from reference_impl.joint_kinds import FREE as FREE
from reference_impl.joint_kinds import HINGE as HINGE
from reference_impl.joint_kinds import KINDS as KINDS
from reference_impl.joint_kinds import ROD as ROD
from reference_impl.joint_kinds import WELD as WELD
from reference_impl.joint_kinds import AxesKind as AxesKind
from reference_impl.joint_kinds import JointKind as JointKind
from reference_impl.joint_kinds import Kind as Kind
from reference_impl.joint_kinds import column_count as column_count
from reference_impl.mechanism import BODY_FIELDS as BODY_FIELDS
from reference_impl.mechanism import JOINT_ELEMENTS as JOINT_ELEMENTS
from reference_impl.mechanism import JOINT_FIELDS as JOINT_FIELDS
from reference_impl.mechanism import SPRING_FIELDS as SPRING_FIELDS
from reference_impl.mechanism import ZERO_INERTIA as ZERO_INERTIA
from reference_impl.mechanism import Mechanism

Model = Mechanism


def shape_words(annotation: str) -> str | None:
    """Return the shape in the annotation of an array, without the axes of a batch; None of other types."""
    shape = re.search(r"""["'](?:\*#batch )?(.*)["']""", annotation)
    return shape[1] if shape else None


def _absent() -> Array:
    return np.zeros((0, 0))


class Unsupported(PlumblineError):
    """The engine has no such feature; the message is the sentence that results and report show."""

    def __init__(self, reason: str, gap: str = "", missing: str = "") -> None:
        """Refuse because of a gap that the column declares, or of none: then the refusal counts.

        Args:
            missing: name that the installed version of the engine lacks, where that is the reason.

        """
        super().__init__(reason)
        self.gap, self.missing = gap, missing


class EngineFailure(PlumblineError):
    """The engine failed at something that it offers; the message says how."""


class BadInput(PlumblineError, ValueError):
    """A state or model was refused before any engine saw it."""


@dataclass(frozen=True, eq=False)
class State:
    """One exact state on the constraint manifold: its minimal coordinates, and all that follows from them.

    Minimal are p and omega of bodies on rods and balls and of free ones, u and udot of rods, r and v of free
    bodies, x and xdot of the other joints; of the other bodies p, omega, r and v follow.  ``u`` is the unit
    direction of rod k, from the point where the rod hangs to the near point of body k, and ``udot`` its rate
    (u·udot = 0); both are zero for other joints.  The rod's angular velocity without axial spin is u × udot.
    `plumbline.model.kinematics.complete_state` computes what follows; what is not given is zero.
    """

    p: Float[Array, "*#batch bodies 4"]
    omega: Float[Array, "*#batch bodies 3"]  # rad/s, body frame
    u: Float[Array, "*#batch bodies 3"] = field(default_factory=_absent)  # world frame
    udot: Float[Array, "*#batch bodies 3"] = field(default_factory=_absent)  # 1/s, world frame
    r: Float[Array, "*#batch bodies 3"] = field(default_factory=_absent)  # m, world frame
    v: Float[Array, "*#batch bodies 3"] = field(default_factory=_absent)  # m/s, world frame: ṙ
    # rad or m: coordinates of joint k in the order of its kind's motions, angles unwrapped; rates
    x: Float[Array, "*#batch bodies coordinates"] = field(default_factory=_absent)
    xdot: Float[Array, "*#batch bodies coordinates"] = field(default_factory=_absent)

    def __post_init__(self) -> None:
        """Put zeros of the right shape where nothing is given."""
        for name, width in (("u", 3), ("udot", 3), ("r", 3), ("v", 3), ("x", 2), ("xdot", 2)):
            if not getattr(self, name).size:
                object.__setattr__(self, name, np.zeros((*self.p.shape[:-1], width)))

    def __getitem__(self, at: Any) -> Self:
        """Take the entries at an index of every array: bodies of one state, or states of many."""
        return replace(self, **{name: x[at] for name, x in vars(self).items()})


# sizes of the value that a field of a mechanism or of a state has at one place, behind the axis of the places
VALUE_SHAPES = {
    one.name: shape.split()[1:]
    for one in (*fields(Model), *fields(State))
    if (shape := shape_words(str(one.type)))
}
VALUE_AXES = {name: len(shape) for name, shape in VALUE_SHAPES.items()}


@dataclass(frozen=True, eq=False)
class StateQuantities:
    """What an engine computes at one state; quantities that it does not offer are None."""

    acceleration: Float[Array, "bodies 3"]  # m/s², r̈ of the centres of mass, world frame
    angular_acceleration: Float[Array, "bodies 3"]  # rad/s², ω̇′, body frame
    # N, force on the near body at the joint's near point, world frame; in loops the determinate part
    joint_reaction: Float[Array, "joints 3"] | None = None
    kinetic_energy: float | None = None  # J
    potential_energy: float | None = None  # J, zero at the pivot: -Σ m g·r
    angular_momentum: Float[Array, "3"] | None = None  # kg m²/s about the pivot, world frame
    # kinetic energy = ½ νᵀ M ν with ν = (udot of the rods in order, then body by body omega, or
    # (v, omega) of a free body, or the xdot of its joint); a rod's 3×3 part acts on udot through u × udot.
    mass_matrix: Float[Array, "nu nu"] | None = None
    # N m, moment on that body about that point, world frame
    joint_moment: Float[Array, "joints 3"] | None = None
    # by quantity the uncertainty of a limit that the engine's answers were extrapolated to, in its unit
    limit_error: Mapping[str, float] | None = None


# The names of the engine's functions, sensors and options that an answer comes from.
Call = tuple[str, ...]
# What an engine reports at one state besides the `StateQuantities`: by quantity (of
# `plumbline.truth.surface_truth`) and by call vectors of bodies or of the mechanism, or a number per entry of
# ν.
SurfaceAnswer = Mapping[str, Mapping[Call, Float[Array, "*states rows d"]]]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Samples of one run at the requested times; row 0 is the initial state.

    ``p`` and ``pdot`` are the engine's own values: not normalised, not projected.
    """

    t: Float[Array, "samples"]  # s
    r: Float[Array, "samples bodies 3"]  # m
    p: Float[Array, "samples bodies 4"]
    v: Float[Array, "samples bodies 3"]  # m/s, ṙ
    pdot: Float[Array, "samples bodies 4"]  # 1/s; ½ L(p)ᵀ ω′ where the engine holds ω′
    steps: int  # steps the integrator took
    # rad or m: joint coordinates at t[0], angles unwrapped; None: principal values there, but with a pitch
    initial_x: Float[Array, "bodies coordinates"] | None = None
    # of a run that is extrapolated from softer ones, the same by an order less: their difference is how
    # uncertain it is
    softer: Trajectory | None = None
    # the engine's own configuration and velocity, joint by joint as `JointSpaceMethod` orders them
    coordinates: Float[Array, "samples entries"] | None = None
    velocities: Float[Array, "samples rates"] | None = None
    solver_rtol: float = 0.0  # relative tolerance to which its implicit steps were solved

    def at(self, samples: Any) -> Trajectory:
        """Take some samples of the motion; the engine's own coordinates stay as they are."""
        parts = {name: getattr(self, name)[samples] for name in ("t", "r", "p", "v", "pdot")}
        return replace(self, **parts, softer=self.softer and self.softer.at(samples))


@dataclass(frozen=True, eq=False)
class StepRun:
    """Consecutive steps of one integrator, and what its formula needs besides the motion."""

    trajectory: Trajectory  # T samples at 0, h, 2 h, …
    # m/s² and 1/s², second derivatives of (r, p)
    coordinate_acceleration: Float[Array, "samples bodies 7"] | None = None
    # multipliers of joint k, three [N], world axes (a rod's first is its tension), and of |p| = 1
    multipliers: Float[Array, "samples bodies 4"] | None = None
    # world axes of revolute joints at the start, from the pivot on
    angle_axes: Float[Array, "angles 3"] | None = None
    # m, rad, m/s, rad/s: uncertainty of positions, attitudes, ṙ and ω′ of each step by itself, where that is
    # the limit of softer ones
    limit_error: Float[Array, "samples 4"] | None = None


STEP_ORDERS = (1, 2, 4)  # of methods with fixed steps whose motions are compared


@dataclass(frozen=True)
class Integrator:
    """One integration method of an engine.

    The ``resolution`` that `Adapter.simulate` receives is the step [s] for ``kind`` "step", and the relative
    tolerance for ``kind`` "tolerance".
    """

    name: str
    kind: Literal["step", "tolerance"]
    order: int  # declared order; of the underlying method for kind "tolerance"
    error_exponents: tuple[int, ...] = ()  # exponents of h in the error expansion, ascending
    is_symmetric: bool = False  # time-symmetric: reversing the velocities retraces the path
    solver_rtol: float = 0.0  # relative tolerance to which an implicit step's equations are solved
    min_rtol: float = 1e-12  # for kind "tolerance": below, rounding on long chains stalls the step
    alias_of: str | None = None  # equals that integrator without drag: not independent evidence
    note: str = ""  # a sentence on what it is
    method: StepMethod | None = None  # the formula of one step; None: the level "step" does not apply
    has_motions: bool = True  # False: compared by single steps alone
    names: Call = ()  # of the engine, that the steps are by
