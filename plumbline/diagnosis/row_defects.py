"""Rows of joints that an engine leaves out or evaluates without what velocities cause."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from plumbline.diagnosis.joint_prediction import RowChange, Seen
from plumbline.diagnosis.misreadings import Misreading
from plumbline.model.datatypes import Array, Model, State
from plumbline.model.kinematics import complete_state, rotation_matrix

NOT_HELD = 1e-9  # of a direction: what the joint holds of it


def row_defects(model: Model) -> Iterator[tuple[str, Misreading]]:
    """List defects of rows.

    Yields:
        Words that complete "behaves as if", and what the engine evaluates.

    """
    for k in range(len(model.kind)):
        if not model.free[k]:
            yield f"the velocity term of joint {k + 1} were missing", _changed(_without_bend(k))
            yield f"joint {k + 1} were left out", _changed(_without_rows(k, np.eye(6)))
            yield from _single_rows(model, k)
    for loop in range(len(model.kind) - model.n):
        yield f"the loop of joint {model.n + loop + 1} were left open", _open(loop)
    if model.has_loops:
        yield "the velocity terms of the rows that close loops were missing", _without_end_terms


def velocity_terms(joint: int) -> list[Misreading]:
    """List units of another acceleration that velocities cause at a joint.

    Args:
        joint: its number from 0.

    Returns:
        What the engine evaluates, one entry per direction, the first three linear; those that the joint does
        not hold change nothing.

    """

    def added(unit: Array) -> RowChange:
        return lambda k, held, bend: (held, bend + unit if k == joint else bend)

    return [_changed(added(unit)) for unit in np.eye(6)]


def missing_gammas(model: Model) -> Iterator[tuple[str, Misreading]]:
    """List rows that an engine in maximal coordinates evaluates without γ.

    Yields:
        Words that complete "behaves as if", and what the engine evaluates.

    """
    for k in range(len(model.kind)):
        if not model.free[k]:
            yield f"γ of the rows of joint {k + 1} were missing", _without_gamma(k)


def _without_gamma(joint: int) -> Misreading:
    return lambda model, state: Seen(model, state, missing_gamma=joint)


def _changed(rows: RowChange) -> Misreading:
    return lambda model, state: Seen(model, state, rows)


def _open(loop: int) -> Misreading:
    return lambda model, state: Seen(model, state, open_loop=loop)


def _without_end_terms(model: Model, state: State) -> Seen:
    return Seen(model, state, end_rows="without velocity terms")


def _without_bend(joint: int) -> RowChange:
    return lambda k, held, bend: (held, 0 * bend if k == joint else bend)


def _without_rows(joint: int, directions: Array) -> RowChange:
    """Directions (6, m) that the joint does not hold."""

    def rows(k: int, held: Array, bend: Array) -> tuple[Array, Array]:
        if k != joint:
            return held, bend
        lost, sizes, _ = np.linalg.svd(held.T @ directions)
        return held @ lost[:, int(np.sum(sizes > NOT_HELD)) :], bend

    return rows


def _single_rows(model: Model, k: int) -> Iterator[tuple[str, Misreading]]:
    """Rows of the table of kinds: of points along axes of several frames, of attitudes about u × w."""
    far, near = model.body[k]
    kind = model.kinds[k]

    def frames(state: State) -> dict[str, Array]:
        turns = rotation_matrix(complete_state(model, state).p)
        above = turns[far] if far >= 0 else np.eye(3)
        joint = rotation_matrix(model.turn[k])
        names = {"ijk": np.eye(3), "xyz": above @ joint[0], "XYZ": turns[near] @ joint[1]}
        return {name: frame[:, i] for axes, frame in names.items() for i, name in enumerate(axes)}

    def without(u: str, w: str) -> Misreading:
        def misread(model: Model, state: State) -> Seen:
            axes = frames(state)
            direction = np.zeros((6, 1))
            if w == "d":
                direction[:3, 0] = axes[u]
            else:
                direction[3:, 0] = np.cross(axes[u], axes[w])
            return Seen(model, state, _without_rows(k, direction))

        return misread

    for u, w in kind.rows:
        if w == "d" and u != "d":
            names = ("xyz"["ijk".index(u)], u, "XYZ"["ijk".index(u)]) if u in "ijk" else (u,)
            for name in names:
                yield f"the row of joint {k + 1} along {name} were left out", without(name, w)
        elif u != "d":
            yield f"the row of joint {k + 1} along {u} × {w} were left out", without(u, w)
