"""The page docs/surface.md, written from the files of adapters/surface.

python -m plumbline.engines.surface_page > docs/surface.md
"""

from __future__ import annotations

from collections.abc import Iterator

from plumbline.engines.surface import (
    COMPARED,
    SURFACE_ROWS,
    SURFACES,
    Surface,
    declared_surface,
    exercised_rows,
)

_HEAD = """# The engines' surface

For everybody who asks what of an engine is compared. The lists are those of `adapters/surface`, which a test
compares with the installed engines: every public name that could be about rigid motion is compared
by rows of a run, outside for one of five reasons (contact, rendering, input and output, memory, another
physics), or not compared yet, with the reason. `plumbline list surface` counts the names and lists those
that the installed version has besides, as a night does.
A name is exercised where a relative change of 1e-6 in what it returns turns a row red
(`python -m plumbline.studies.exercised_names > adapters/surface/exercised.json` computes it). Of names that a
variant or the column itself uses together, everything that they return together is changed.

Wrong so far, each with a script or an entry of the known issues, are

- MuJoCo's sensor of the actuator force at a tendon, `tendonactuatorfrc`, which leaves out the
  gears ([script](surface/mujoco_tendon_actuator_force.py)), and before 4.0 `cdof` and
  `cdof_dot` of joints by name or number ([script](surface/mujoco_named_joint_axes.py));
- Pinocchio's rates of Jacobians, Coriolis matrix, rate of the centroidal map and analytical derivatives where
  a composite joint is universal or planar ([script](surface/pinocchio_composite_rates.py)), its
  `computeMinverse` on long chains, its kinetic energy of rotors on revolute and helical joints about a given
  axis ([script](surface/pinocchio_kinetic_energy_of_rotors.py)), the gravity of models that `appendModel`
  makes ([script](surface/pinocchio_append_model.py)), the pitch of screw joints that are made without one
  ([script](surface/pinocchio_pitch_of_screws.py)), the Delassus matrices of constraints between two bodies
  ([script](surface/pinocchio_delassus_of_two_bodies.py)), and the order of the entries of kinematic
  Hessians in Python ([script](surface/pinocchio_kinematic_hessians.py));
- Exudyn's tangent operators of SE(3), `TExpSE3` and `TExpSE3Inv`
  ([script](surface/exudyn_tangent_operators.py)), `GetODE2CoordinatesTotal`, which corrupts memory
  ([script](surface/exudyn_coordinates_total.py)), the masses that slides of `KinematicTree33` carry
  ([script](surface/exudyn_kinematic_tree_33.py)), and the steps of `ODE23` and `DOPRI5`, which depend on the
  sign of coordinates ([script](surface/exudyn_step_control.py)).

Written by `python -m plumbline.engines.surface_page > docs/surface.md`.
"""


def surface_page() -> str:
    """Write the page.

    Returns:
        Markdown.

    """
    surfaces = [declared_surface(name) for name in SURFACES]
    lines = [
        _HEAD,
        "| engine | version | compared | exercised | not yet | outside | exercised of all not outside |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in surfaces:
        count, exercised = one.counts(), len(exercised_rows(one.engine))
        inside = count[COMPARED] + count["not yet"]
        cells = one.engine, one.version, count[COMPARED], exercised, count["not yet"], count["outside"]
        lines.append(f"| {' | '.join(map(str, cells))} | {100 * exercised / inside:.0f} % |")
    for one in surfaces:
        lines += _section(one)
    return "\n".join(lines) + "\n"


def _section(surface: Surface) -> Iterator[str]:
    titles = {COMPARED: "Compared, by rows", "not yet": "Not yet", "outside": "Outside"}
    yield from ("", f"## {surface.engine}")
    for status, title in titles.items():
        yield from ("", f"### {title}", "")
        details: dict[str, list[str]] = {}
        for one in surface.names:
            if one.status == status:
                details.setdefault(one.detail, []).append(one.name)
        if names := details.pop(SURFACE_ROWS, []):
            yield from ("| exercised name | rows that a change of 1e-6 turns red |", "|---|---|")
            rows = exercised_rows(surface.engine)
            for name in names:
                yield f"| `{name}` | {', '.join(rows[name])} |"
            yield ""
        for detail, names in sorted(details.items()):
            yield f"- {detail}: {', '.join(f'`{name}`' for name in names)}"


if __name__ == "__main__":
    print(surface_page(), end="")
