"""Functions of an engine's library of attitudes, poses and their rates, compared on a mechanism's bodies.

`adapters/surface/pose_functions.json` says by engine and name, in words like "L.p Q.p -> p", what a function
is given and what it returns.  What it is given comes from our own formulas, and what it returns is taken back
by our own formulas to the positions, axes and velocities of the body, which have a truth.  Poses are that of
the body, which has no letter, and

    Q       one near a fixed one, where no form of an attitude is near a singular one; rates are given there
    L, I    with body = L Q and I = body⁻¹
    K, M    a fixed one, and M with Q = M K

    R p xyzw phi xyz rpy zyz skew   attitude: matrix, quaternion with the scalar first and last, rotation
                            vector, angles of Rx Ry Rz, Rz Ry Rx and Rz Ry Rz, matrix of the rotation vector;
                            x y z are the three of xyz, axis and angle the parts of phi;
                            phi+ is phi and a whole turn more, and R+ p+ xyzw+ what is returned of it
    r S                     position, and its matrix of a cross product
    rp rxyzw rphi rxyz      position and attitude; shift: what takes rphi of M to that of Q, and
                            dr what takes r of L to that of the body
    H X XI G xi log         4 × 4 matrix; Plücker matrix, angular part first, and its inverse; 7 × 7 matrix of
                            R³ × SO(3); logarithm on SE(3), linear part first, and its 4 × 4 matrix
    w wl t                  angular velocity in the world and in Q's axes; twist in these, linear part first
    vwl rphidot             ṙ in the world with w in Q's axes, or with the rate of phi
    pdot 2pdot phidot xyzdot rpydot xidot    rates of the forms
    xyzbend rpybend         rates of angles about as large as √ω, and what the rate of the matrix that takes
                            rates to ω makes of them: Σ θ̇ᵢ θ̇ⱼ aᵢ × aⱼ of the axes a, in Q's axes, and
                            xyzbendw in the world's

A result "@pdot w" is a matrix that takes the first to the second.  "Rx" is the turn by x alone, "x" its
angle, and "Tx" the shift by one coordinate, as a matrix of any kind; -Rx and -Tx are their inverses (of
Exudyn, Plücker matrices of shifts alone are inverse to those of shifts with turns).  Numbers, and texts in
quotes, are given as they stand.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from adapters.surface_record import Answer
from plumbline.engines.missing_names import add_parts
from plumbline.layout import ROOT
from plumbline.model.datatypes import Array, Float, State
from plumbline.model.kinematics import (
    angular_velocity,
    cross_matrix,
    quaternion_conjugate,
    quaternion_exponential,
    quaternion_product,
    quaternion_rate,
    rotation_matrix,
    rotation_vector,
)
from plumbline.model.probe_frames import PROBE_TURN

FIXED_PLACE = np.array([0.3, -0.2, 0.5])
FIXED_TURN, OTHER_TURN = (
    np.array(x) / np.sqrt(102.0) for x in ([8.0, 3.0, -2.0, 5.0], [9.0, -2.0, 4.0, 1.0])
)
POSE_STATES = 2  # at which they are called
REST = 1e-12  # relative to a matrix's largest entry: rounding of entries that say what others say, too
TERMS = 40  # of a series in rotation vectors up to π


def xyz_angles(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the angles about x, y, z in turn, intrinsic."""
    first = np.arctan2(-R[1, 2], R[2, 2])
    rest = about(0, -first) @ R  # also where the first is arbitrary
    return np.array([first, np.arctan2(rest[0, 2], rest[2, 2]), np.arctan2(rest[1, 0], rest[1, 1])])


def about(axis: int, angle: float) -> Float[Array, "3 3"]:
    """Return the turn about a coordinate axis."""
    return rotation_matrix(np.append(np.cos(angle / 2), np.sin(angle / 2) * np.eye(3)[axis]))


def homogeneous(turn: Float[Array, "3 3"], place: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Return the matrix of a pose."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, place
    return pose


def plucker(turn: Float[Array, "3 3"], place: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """Return the Plücker matrix of a pose."""
    pose = np.zeros((6, 6))
    pose[:3, :3] = pose[3:, 3:] = turn
    pose[3:, :3] = cross_matrix(place) @ turn
    return pose


def turned(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the turn by angles about x, y, z in turn, intrinsic."""
    return about(0, angles[0]) @ about(1, angles[1]) @ about(2, angles[2])


def _mean_of_exponential(generator: Array) -> Array:
    """Σ Gᵏ / (k + 1)!: of [φ] the left Jacobian of the exponential, of −[φ] the right one."""
    total: Array = np.eye(len(generator))
    term = total
    for k in range(1, TERMS):
        term = term @ generator / (k + 1)
        total = total + term
    return total


def _place_on_se3(xi: Array) -> Array:
    return _mean_of_exponential(cross_matrix(xi[3:])) @ xi[:3]


class Pose:
    """A pose in all forms."""

    def __init__(self, r: Array, p: Array) -> None:
        self.r, self.p = r, p
        self.R = rotation_matrix(p)

    def __mul__(self, other: Pose) -> Pose:
        return Pose(self.r + self.R @ other.r, quaternion_product(self.p, other.p))

    def inverse(self) -> Pose:
        """The pose of the world in this one."""
        return Pose(-self.R.T @ self.r, quaternion_conjugate(self.p))

    @cached_property
    def forms(self) -> Mapping[str, Any]:
        """By name; x, y and z are numbers."""
        phi, xyz = rotation_vector(self.p), xyz_angles(self.R)
        H, G = homogeneous(self.R, self.r), np.eye(7)
        G[:3, :3], G[3:6, 6] = self.R, self.r
        X, XI = plucker(self.R, self.r), plucker(self.R.T, -self.R.T @ self.r)
        xi = np.append(np.linalg.solve(_mean_of_exponential(cross_matrix(phi)), self.r), phi)
        angle = float(np.linalg.norm(phi))
        named: dict[str, Any] = {
            "R": self.R,
            "p": self.p,
            "xyzw": np.roll(self.p, -1),
            "phi": phi,
            "xyz": xyz,
        }
        named |= {"r" + form: np.append(self.r, named[form]) for form in ("p", "xyzw", "phi", "xyz")}
        named |= {"r": self.r, "rpy": -xyz_angles(self.R.T), "H": H, "X": X, "XI": XI, "G": G, "xi": xi}
        named |= {"S": cross_matrix(self.r), "axis": phi / angle if angle else np.eye(3)[2], "angle": angle}
        named["phi+"] = (angle + 2 * np.pi) * named["axis"]
        return named | dict(zip(("x", "y", "z", "rx", "ry", "rz"), map(float, [*xyz, *self.r]), strict=True))


def _beside_velocity(turning: Array, Q: Pose) -> Array:
    """The twist's map from ṙ in the world and from what ``turning`` takes to ω in Q's axes."""
    return np.block([[Q.R.T, np.zeros((3, 3))], [np.zeros((3, 3)), turning]])


def rate_maps(Q: Pose) -> dict[str, Array]:
    """Return matrices at Q from the rates of forms to ω in Q's axes, or to the twist in them."""
    phi, (a, *_), (u, v, _) = (Q.forms[name] for name in ("phi", "xyz", "rpy"))
    of_xyz = [Q.R.T @ axis for axis in (np.eye(3)[0], about(0, a)[:, 1], Q.R[:, 2])]
    of_rpy = [np.eye(3)[0], about(0, u).T[:, 1], (about(1, v) @ about(0, u)).T[:, 2]]
    xi = Q.forms["xi"]
    generator: Array = np.asarray(np.kron(np.eye(2), cross_matrix(xi[3:])), float)
    generator[:3, 3:] = cross_matrix(xi[:3])
    of_p = np.stack([angular_velocity(Q.p, axis) for axis in np.eye(4)], 1)
    of_phi = _mean_of_exponential(-cross_matrix(phi))
    return {
        "xyzdot": np.stack(of_xyz, 1), "rpydot": np.stack(of_rpy, 1), "w": Q.R.T, "wl": np.eye(3),
        "phidot": of_phi, "xidot": _mean_of_exponential(-generator), "pdot": of_p, "t": np.eye(6),
        "rphidot": _beside_velocity(of_phi, Q), "vwl": _beside_velocity(np.eye(3), Q), "2pdot": of_p / 2,
    }  # fmt: skip


def _bend(spins: Array) -> Array:
    """Σ ωᵢ × ωⱼ of turns in a row, i before j."""
    return np.asarray(np.sum(np.cross(np.cumsum(spins, axis=0) - spins, spins), axis=0))


class _Body:
    """A body at a state: what functions are given, and what their results are."""

    def __init__(self, state: State, k: int, omega: Array) -> None:
        self.pose, length = Pose(state.r[k], state.p[k]), np.linalg.norm(state.r[k])
        near = quaternion_product(FIXED_TURN, quaternion_exponential(0.3 * state.p[k, 1:]))
        # no place far from where the bodies are
        Q, K = [Pose(length * FIXED_PLACE, turn) for turn in (near, OTHER_TURN)]
        self.Q, M, L = Q, Q * K.inverse(), self.pose * Q.inverse()
        self.poses = {"": self.pose, "Q": Q, "K": K, "L": L, "M": M, "I": self.pose.inverse()}
        self.maps, spin = rate_maps(Q), Q.R.T @ omega
        twist = np.append(Q.R.T @ state.v[k], spin)
        self.rates: dict[str, Any] = {"pdot": quaternion_rate(Q.p, spin), "dr": self.pose.r - L.r}
        self.rates["shift"] = np.append(Q.r - M.r, K.forms["phi"])
        for name, matrix in self.maps.items():
            if "pdot" not in name:
                self.rates[name] = np.linalg.solve(matrix, twist if len(matrix) == 6 else spin)
        self.spin, self.bends = spin, dict[str, Array]()
        for name, order in (("xyz", 1), ("rpy", -1)):
            self.rates[f"{name}bend"] = given = self.rates[f"{name}dot"] / np.sqrt(np.linalg.norm(spin) + 1)
            self.bends[f"{name}bend"] = _bend((self.maps[f"{name}dot"] * given).T[::order])

    def given(self, name: str) -> Any:
        if name[0] in "'-0123456789":
            return name[1:-1] if name[0] == "'" else int(name)
        pose, _, form = name.rpartition(".")
        return self.poses[pose].forms[form] if form not in self.rates else self.rates[form]

    def read(self, form: str, value: Array) -> dict[str, Array]:
        """Take a result to quantities of the body."""
        if form in self.maps:
            *linear, angular = (self.maps[form] @ value).reshape(-1, 3) @ self.Q.R.T
            if not linear:
                return {"frame_angular_velocity": angular}
            by = "_by_tangent_operator"
            return {f"body_velocity{by}": linear[0], f"frame_angular_velocity{by}": angular}
        if form.removesuffix("w") in self.bends:
            turned = value @ self.Q.R if form.endswith("w") else value
            spin = self.spin + turned - self.bends[form.removesuffix("w")]
            return {"frame_angular_velocity": self.Q.R @ spin}
        pose, _, form = form.rpartition(".")
        axes = "frame_axes_by_whole_turns" if form.endswith("+") else "frame_axes"
        form = form.removesuffix("+")
        if np.ndim(value) > 1 and not np.allclose(
            value, _whole(form, value), REST, REST * np.max(np.abs(value))
        ):
            value = np.nan * value
        found, above = {}, self.pose * self.poses[pose].inverse() if pose else None
        if (turn := self._attitude(form, value)) is not None:
            found[axes] = ((above.R @ turn if above else turn) @ PROBE_TURN).T
        if (place := self._place(form, value)) is not None:
            found["body_position"] = above.r + above.R @ place if above else place
        return found

    def _attitude(self, form: str, value: Array) -> Array | None:
        name = form.removeprefix("-")
        if name in ("Rx", "Ry", "Rz"):
            turns = [about(axis, angle) for axis, angle in enumerate(self.pose.forms["xyz"])]
            turns["xyz".index(name[1])] = value[:3, :3].T if name != form else value[:3, :3]
            return turns[0] @ turns[1] @ turns[2]
        if name in ("x", "y", "z"):
            return self._attitude(f"R{name}", about("xyz".index(name), float(value)))
        if name == "axis":
            return _turn(value * self.pose.forms["angle"])
        return ATTITUDES[name](value) if name in ATTITUDES else None

    def _place(self, form: str, value: Array) -> Array | None:
        sign, name = (-1 if form.startswith("-") else 1), form.removeprefix("-")
        if name in ("Tx", "Ty", "Tz"):
            is_other = np.arange(3) != "xyz".index(name[1])
            return np.asarray(sign * _shift(value) + is_other * self.pose.r)
        return sign * PLACES[name](value) if name in PLACES else None


def _whole(form: str, value: Array) -> Array:
    """What a matrix is by the entries that are read of it."""
    name = form.removeprefix("-")
    if name in ("skew", "S"):
        return cross_matrix(_vector_of(value))
    if name == "log":
        return np.vstack([np.column_stack([cross_matrix(_vector_of(value)), value[:3, 3]]), np.zeros(4)])
    turn = np.eye(3) if name[0] == "T" else value[:3, :3]
    moves = float(name not in ("Rx", "Ry", "Rz"))
    if len(value) == 4:
        return homogeneous(turn, moves * value[:3, 3])
    if len(value) == 6:
        return plucker(turn, moves * _vector_of(value[3:, :3] @ turn.T))
    if len(value) == 7:
        whole = np.eye(7)
        whole[:3, :3], whole[3:6, 6] = turn, value[3:6, 6]
        return whole
    return value


def _shift(value: Array) -> Array:
    """The shift of a pose, or of a Plücker matrix without a turn."""
    return value[:3, 3] if len(value) == 4 else _vector_of(value[3:])


def _turn(phi: Array) -> Array:
    return rotation_matrix(quaternion_exponential(phi / 2))


Reader = Callable[[Array], Array]


def _by_form(*readers: tuple[str, Reader]) -> dict[str, Reader]:
    return {form: read for forms, read in readers for form in forms.split()}


# By form what takes a result to an attitude, and to a place.
ATTITUDES = _by_form(
    ("R", lambda x: x.reshape(3, 3)),
    ("p rp", lambda x: rotation_matrix(x[-4:])),
    ("xyzw rxyzw", lambda x: rotation_matrix(np.roll(x[-4:], 1))),
    ("phi xi rphi", lambda x: _turn(x[-3:])),
    ("skew log", lambda x: _turn(_vector_of(x))),
    ("xyz rxyz", lambda x: turned(x[-3:])),
    ("rpy", lambda x: turned(-x).T),
    ("zyz", lambda x: about(2, x[0]) @ about(1, x[1]) @ about(2, x[2])),
    ("H G", lambda x: x[:3, :3]),
    ("X", lambda x: x[:3, :3]),
    ("XI", lambda x: x[:3, :3].T),
)
PLACES = _by_form(
    ("r rp rxyzw rphi rxyz", lambda x: x[:3]),
    ("H T", _shift),
    ("G", lambda x: x[3:6, 6]),
    ("S", lambda x: _vector_of(x)),
    ("X", lambda x: _vector_of(x[3:, :3] @ x[:3, :3].T)),
    ("XI", lambda x: _vector_of(-x[:3, :3].T @ x[3:, :3])),
    ("xi", _place_on_se3),
    ("log", lambda x: _place_on_se3(np.append(x[:3, 3], _vector_of(x)))),
)


def _vector_of(matrix: Array) -> Array:
    """The vector of a matrix of a cross product."""
    return np.array([matrix[2, 1], matrix[0, 2], matrix[1, 0]])


# By engine and name of its functions what each is given and returns.
POSE_TABLES: Mapping[str, Mapping[str, str]] = json.loads(
    (ROOT / "adapters" / "surface" / "pose_functions.json").read_text(encoding="utf-8")
)


# Takes a name, the values that it is given and the forms of the results to the results.
PoseFunction = Callable[[str, Sequence[Any], Sequence[str]], Sequence[Any]]


def add_pose_answers(
    answers: Sequence[Answer], states: Sequence[State], engine: str, call: PoseFunction
) -> None:
    """Call all functions of an engine on all bodies at the first states; add what they say to the answers.

    Args:
        answers: of the surface, at these states.
        engine: whose table it is.
        call: calls a function of it.

    """
    for answer, state in zip(answers, states[:POSE_STATES], strict=False):
        bodies = cache(partial(_bodies, state))
        add_parts(
            answer,
            *(partial(_add_pose_answer, answer, one, call, bodies) for one in POSE_TABLES[engine].items()),
        )


def _bodies(state: State) -> list[_Body]:
    turns = rotation_matrix(state.p)
    return [_Body(state, k, turns[k] @ state.omega[k]) for k in range(len(state.p))]


def _add_pose_answer(
    answer: Answer, function: tuple[str, str], call: PoseFunction, bodies: Callable[[], Sequence[_Body]]
) -> None:
    """Call a function, whose name and forms are given, on all bodies; average what says the same of one."""
    rows = defaultdict[str, list[Array]](list)
    name, texts = function
    for body in bodies():
        own = defaultdict[str, list[Array]](list)
        for text in texts.split("; "):
            given, _, returned = text.partition(" -> ")
            forms = returned.split()
            results = call(
                name, [body.given(one) for one in given.split()], [form.removesuffix("+") for form in forms]
            )
            if forms[0].startswith("@"):
                rate = body.given(forms.pop(0)[1:])
                results = [np.reshape(results[0], (-1, len(rate))) @ rate]
            for form, value in zip(forms, results, strict=True):
                for quantity, vector in body.read(form, np.asarray(value, float)).items():
                    own[quantity].append(np.atleast_2d(vector))
        for quantity, vectors in own.items():
            rows[quantity].append(np.mean(vectors, axis=0))
    for quantity, vectors in rows.items():
        answer.setdefault(quantity, {})[name,] = np.concatenate(vectors)
