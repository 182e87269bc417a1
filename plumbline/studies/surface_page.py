"""The tables of docs/surface.md and docs/surface/ENGINE.md, written from the files of adapters/surface.

python -m plumbline.studies.surface_page
"""

from __future__ import annotations

import textwrap
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
from plumbline.judging.known_issues import recorded_mistakes
from plumbline.judging.state_level import STATE_UNITS
from plumbline.layout import ROOT, generated_page
from plumbline.model.grouping import grouped

_TITLES = {COMPARED: "Compared", NOT_YET: "Not compared yet", OUTSIDE_STATUS: "Outside"}
_NAMES = {"mujoco": "MuJoCo", "pinocchio": "Pinocchio", "exudyn": "Exudyn"}


def surface_pages() -> dict[str, str]:
    """Return all pages with new tables, by path relative to the folder of the documentation."""
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
    parts = {f"surface/{one.engine}.md": [*_engine_tables(one)] for one in surfaces}
    parts["surface.md"] = lines
    return {path: generated_page(path, "\n".join(part) + "\n") for path, part in parts.items()}


def _engine_tables(surface: Surface) -> Iterator[str]:
    places = grouped(surface.names, lambda one: one.place)
    yield "## Wrong so far\n"
    for wrong in recorded_mistakes():
        if wrong.engine.partition("-")[0] == surface.engine:
            script = f" ([script]({wrong.script}))" if wrong.script else ""
            since = f", since {wrong.since}" if wrong.since else ""
            text = f"- {wrong.id}: {wrong.reason} Versions {wrong.versions}{since}{script}."
            yield textwrap.fill(
                text, 110, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
            )
    yield f"\n## Places\n\nThe names are those of version {surface.version}.\n"
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
    groups = grouped(names, lambda one: _shortened(rows[one.name]))
    if groups:
        yield "| exercised names | rows that a change turns red |\n|---|---|"
        for words, own in groups.items():
            yield f"| {_listed(own)} | {words} |"
        yield ""


def _by_detail(names: Sequence[SurfaceName]) -> Iterator[str]:
    details = grouped(names, lambda one: one.detail)
    for detail, own in sorted(details.items()):
        yield f"- {detail}: {_listed(own)}"
    if details:
        yield ""


def _listed(names: Sequence[SurfaceName]) -> str:
    return ", ".join(f"`{one.name.rpartition('.')[2]}`" for one in names)


# Quantities of the level "state", of variants with an ending: together where they are most of a list.
_KINDS = {"": "state", "_by_option": "state by option", "_by_spelling": "state by spelling",
          "_by_vectors": "state by vectors"}  # fmt: skip


def _shortened(rows: Sequence[str]) -> str:
    """The rows in words: families of the level "state" by one word each."""
    found, left = list[str](), list(rows)
    for ending, word in _KINDS.items():
        family = [row for row in left if row.removesuffix(ending) in STATE_UNITS and row.endswith(ending)]
        if len(family) > len(STATE_UNITS) // 2:
            found.append(word)
            left = [row for row in left if row not in family]
    return ", ".join(found + left)


def main() -> None:
    """Write all pages into the folder of the documentation."""
    for path, text in surface_pages().items():
        (ROOT / "docs" / path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
