"""The pages docs/surface.md and docs/surface/ENGINE.md, written from the files of adapters/surface.

python -m plumbline.engines.surface_page
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from plumbline.engines.surface import (
    COMPARED,
    NOT_YET,
    OUTSIDE_STATUS,
    STATUSES,
    SURFACE_ROWS,
    SURFACES,
    Surface,
    SurfaceName,
    declared_surface,
    exercised_rows,
)
from plumbline.layout import ROOT

_HEAD = """# The engines' surface

For everybody who asks what of an engine is compared. Every public name that could be about rigid motion is
compared by rows of a run, not compared yet with the reason, or outside for one of five reasons (contact,
rendering, input and output, memory, another physics):

"""
_REST = """
A page has the names by module, class and enumeration, and what is wrong so far; each name stands on it
once. The lists are those of `adapters/surface`, which a test compares with the installed engines.
`plumbline list surface` counts the names and lists those that the installed version has besides, as a night
does.

A name is exercised where a relative change of 1e-6 in what it returns turns a row red (`python -m
plumbline.studies.exercised_names > adapters/surface/exercised.json` computes it). Of names that a variant
or the column itself uses together, everything that they return together is changed. Settings of Exudyn's
solvers are compared on mass points that are pushed to the positions of the bodies, by a force that makes
each parameter of a method show, and items that no column builds a mechanism of are put where the bodies are
([points](../adapters/exudyn_points.py), [items](../adapters/exudyn_items.py)): on mechanisms of up to three
bodies, at one state.

Written by `python -m plumbline.engines.surface_page`.
"""
_TITLES = {COMPARED: "Compared", NOT_YET: "Not compared yet", OUTSIDE_STATUS: "Outside"}
_NAMES = {"mujoco": "MuJoCo", "pinocchio": "Pinocchio", "exudyn": "Exudyn"}
_WRONG: Mapping[str, str] = {
    "mujoco": """\
- The sensor of the actuator force at a tendon, `tendonactuatorfrc`, leaves out the gears
  ([script](mujoco_tendon_actuator_force.py)).
- Products of inertia of bodies whose axes are turned by 1e-6 rad or less are left out
  ([script](mujoco_small_products_of_inertia.py)).
- Before 4.0 `cdof` and `cdof_dot` of joints by name or number are those of others
  ([script](mujoco_named_joint_axes.py)), and before 3.14 the moments of joints count the
  multipliers of welds for their moments ([script](mujoco_weld_moments.py)).
""",
    "pinocchio": """\
- Rates of Jacobians, Coriolis matrix, rate of the centroidal map and analytical derivatives where a
  composite joint is universal or planar ([script](pinocchio_composite_rates.py)).
- `computeMinverse` on long chains.
- The kinetic energy of rotors on revolute and helical joints about a given axis
  ([script](pinocchio_kinetic_energy_of_rotors.py)).
- The gravity of models that `appendModel` makes ([script](pinocchio_append_model.py)), and the pitch of
  screw joints that are made without one ([script](pinocchio_pitch_of_screws.py)).
- The Delassus matrices of constraints between two bodies ([script](pinocchio_delassus_of_two_bodies.py)).
- The order of the entries of kinematic Hessians in Python ([script](pinocchio_kinematic_hessians.py)).
""",
    "exudyn": """\
- The tangent operators of SE(3), `TExpSE3` and `TExpSE3Inv` ([script](exudyn_tangent_operators.py)).
- `GetODE2CoordinatesTotal`, which corrupts memory ([script](exudyn_coordinates_total.py)).
- The masses that slides of `KinematicTree33` carry ([script](exudyn_kinematic_tree_33.py)).
- The steps of `ODE23` and `DOPRI5`, which depend on the sign of coordinates
  ([script](exudyn_step_control.py)).
- Functions in Python for `PostNewton`, which are called only where `ComputeNewtonResidual` has one, too
  ([script](exudyn_post_newton_function.py)).
""",
}


def surface_pages() -> dict[str, str]:
    """Write all pages.

    Returns:
        By path relative to the folder of the documentation Markdown.

    """
    surfaces = [declared_surface(name) for name in SURFACES]
    lines = [
        "| engine | version | compared | exercised | not yet | outside | exercised of all not outside |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in surfaces:
        count, exercised = one.counts(), len(exercised_rows(one.engine))
        inside = count[COMPARED] + count[NOT_YET]
        link = f"[{_NAMES[one.engine]}](surface/{one.engine}.md)"
        cells = link, one.version, count[COMPARED], exercised, count[NOT_YET], count[OUTSIDE_STATUS]
        lines.append(f"| {' | '.join(map(str, cells))} | {100 * exercised / inside:.0f} % |")
    pages = {f"surface/{one.engine}.md": "\n".join(_engine_page(one)) + "\n" for one in surfaces}
    return {"surface.md": _HEAD + "\n".join(lines) + "\n" + _REST, **pages}


def _engine_page(surface: Surface) -> Iterator[str]:
    name, places = _NAMES[surface.engine], dict[str, list[SurfaceName]]()
    for one in surface.names:
        places.setdefault(one.place, []).append(one)
    yield f"# What of {name} is compared\n"
    yield f"For everybody who asks whether a name of {name} {surface.version} is compared: search it here."
    yield "[The overview](../surface.md) says what the words mean.\n"
    yield f"## Wrong so far\n\n{_WRONG[surface.engine]}"
    yield "## Places\n"
    yield "| names | compared | not yet | outside | not about motion |\n|---|---|---|---|---|"
    for place, names in places.items():
        counts = [sum(one.status == status for one in names) for status in
                  (COMPARED, NOT_YET, OUTSIDE_STATUS, STATUSES[-1])]  # fmt: skip
        anchor = "".join(x for x in place.lower().replace(" ", "-") if x.isalnum() or x in "-_")
        yield f"| [{place}](#{anchor}) | {' | '.join(str(count or '') for count in counts)} |"
    rows = exercised_rows(surface.engine)
    for place, names in places.items():
        yield f"\n## {place}\n"
        for status, title in _TITLES.items():
            own = [one for one in names if one.status == status]
            if own:
                yield f"{title}:\n"
                yield from _by_rows([one for one in own if one.detail == SURFACE_ROWS], rows)
                yield from _by_detail([one for one in own if one.detail != SURFACE_ROWS])


def _by_rows(names: Sequence[SurfaceName], rows: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A table of names, those together that turn the same rows red."""
    groups: dict[str, list[SurfaceName]] = {}
    for one in names:
        groups.setdefault(_shortened(rows[one.name]), []).append(one)
    if groups:
        yield "| exercised names | rows that a change turns red |\n|---|---|"
        for words, own in groups.items():
            yield f"| {_listed(own)} | {words} |"
        yield ""


def _by_detail(names: Sequence[SurfaceName]) -> Iterator[str]:
    details: dict[str, list[SurfaceName]] = {}
    for one in names:
        details.setdefault(one.detail, []).append(one)
    for detail, own in sorted(details.items()):
        yield f"- {detail}: {_listed(own)}"
    if details:
        yield ""


def _listed(names: Sequence[SurfaceName]) -> str:
    return ", ".join(f"`{one.name.rpartition('.')[2]}`" for one in names)


# Quantities of the level "state", of variants with an ending: together where they are most of a list.
_STATE = ("acceleration", "angular_acceleration", "angular_momentum", "joint_moment", "joint_reaction",
          "kinetic_energy", "mass_matrix", "potential_energy")  # fmt: skip
_KINDS = {"": "state", "_by_option": "state by option", "_by_spelling": "state by spelling",
          "_by_vectors": "state by vectors"}  # fmt: skip


def _shortened(rows: Sequence[str]) -> str:
    """The rows in words: families of the level "state" by one word each."""
    found, left = list[str](), list(rows)
    for ending, word in _KINDS.items():
        family = [row for row in left if row.removesuffix(ending) in _STATE and row.endswith(ending)]
        if len(family) > len(_STATE) // 2:
            found.append(word)
            left = [row for row in left if row not in family]
    return ", ".join(found + left)


def main() -> None:
    """Write all pages into the folder of the documentation."""
    for path, text in surface_pages().items():
        (ROOT / "docs" / path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
