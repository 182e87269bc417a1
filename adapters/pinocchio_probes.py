"""A tree of Pinocchio at a state with probe frames on its bodies, and what is found of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from adapters.pinocchio_common import WORLD_ALIGNED, add_frame, joint_of
from adapters.surface_record import SurfaceRecord
from plumbline.model.datatypes import Array, Float, Model
from plumbline.model.probe_frames import PROBE_TURN, probe_points


def add_probe_frames(
    pin_model: pin.Model, joints: Sequence[int], placements: Sequence[pin.SE3], model: Model
) -> list[int]:
    """Add the probe frames of all bodies.

    Args:
        joints: by body the joint that carries it.
        placements: of each body's frame in that joint's frame.

    """
    own = enumerate(zip(joints, placements, probe_points(model), strict=True))
    return [add_frame(pin_model, f"probe {k}", j, at * pin.SE3(PROBE_TURN, x)) for k, (j, at, x) in own]


class Probed(SurfaceRecord):
    """The tree at q, v and v̇; ``rates`` takes ν to v, None of loops, whose parts of bodies are no bodies."""

    def __init__(
        self,
        m: pin.Model,
        frames: Sequence[int],
        motion: tuple[Float[Array, "nq"], Float[Array, "nv"], Float[Array, "nv"]],
        rates: Float[Array, "nv nu"] | None,
    ) -> None:
        super().__init__(rates)
        self.m, self.frames = m, frames
        self.motion = self.q, self.v, self.a = motion
        self.joints = [joint_of(m.frames[f]) for f in frames]
        self.places = [m.frames[f].placement.copy() for f in frames]
        self.workspaces, self.used = list[pin.Data](), 0

    @property
    def has_parts(self) -> bool:
        """Whether a joint carries several bodies, or parts of one."""
        return self.rates is None or len(set(self.joints)) < len(self.joints)

    def workspace(self) -> pin.Data:
        """Data for one function after another; where a part has run at another state, those that it had."""
        self.used += 1
        if self.used > len(self.workspaces):
            self.workspaces.append(self.m.createData())
        return self.workspaces[self.used - 1]

    def moved(self, a: Float[Array, "nv"] | None = None) -> pin.Data:
        """Data with the motion, or one with another v̇, and the frames."""
        data = self.workspace()
        pin.forwardKinematics(self.m, data, self.q, self.v, self.a if a is None else np.ravel(a))
        pin.updateFramePlacements(self.m, data)
        return data

    def columns(self, joint: int) -> list[int]:
        """The velocities that move a joint."""
        own = [range(self.m.idx_vs[k], self.m.idx_vs[k] + self.m.nvs[k]) for k in self.m.supports[joint]]
        return [i for some in own for i in some]

    def square(self, matrix: Any) -> Float[Array, "rows nv"]:
        """A matrix with a column per velocity; Pinocchio returns one of one column as a vector."""
        return np.reshape(matrix, (-1, self.m.nv)).copy()

    def rate(self, by_q: Any, by_v: Any, v: Float[Array, "nv"] | None = None) -> Float[Array, "rows"]:
        """The rate of something whose derivatives by q and v these are."""
        return self.square(by_q) @ (self.v if v is None else v) + self.square(by_v) @ self.a

    def add_poses(self, names: str, poses: Iterable[pin.SE3]) -> None:
        """Add those of the probe frames."""
        own = [pose.homogeneous for pose in poses]
        self.add("frame_position", names, [H[:3, 3] for H in own])
        self.add_axes(names, [H[:3, :3] for H in own])

    def add_twists(self, quantities: tuple[str, str], names: str, twists: Iterable[Any]) -> None:
        """Add the linear and the angular parts of spatial vectors."""
        self.add_halves(quantities, names, [getattr(twist, "vector", twist) for twist in twists])

    def add_velocities(self, velocities: Mapping[str, Any]) -> None:
        """Add the velocities of the probe frames by other v."""
        data = self.workspace()
        for names, v in velocities.items():
            pin.forwardKinematics(self.m, data, self.q, v)
            pin.updateFramePlacements(self.m, data)
            twists = [pin.getFrameVelocity(self.m, data, f, WORLD_ALIGNED).copy() for f in self.frames]
            self.add_twists(("frame_velocity", "frame_angular_velocity"), names, twists)

    def add_accelerations(self, names: str, a: Any, suffix: str = "by_derivative") -> None:
        """Add the accelerations of the probe frames by another v̇."""
        data = self.moved(a)
        quantities = f"frame_acceleration_{suffix}", f"frame_angular_acceleration_{suffix}"
        classical = pin.getFrameClassicalAcceleration
        twists = [classical(self.m, data, f, WORLD_ALIGNED).copy() for f in self.frames]
        self.add_twists(quantities, names, twists)

    def add_momentum(self, names: str, twist: Any, suffix: str = "") -> None:
        """Add the momentum of the mechanism about its centre of mass, or its rate."""
        quantities = f"momentum{suffix}", f"centroidal_angular_momentum{suffix}"
        self.add_twists(quantities, names, [twist])
