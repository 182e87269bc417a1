"""The page docs/surface.md, written from the files of adapters/surface.

python -m plumbline.engines.surface_page > docs/surface.md
"""

from __future__ import annotations

from collections.abc import Iterator

from plumbline.engines.surface import COMPARED, SURFACES, Surface, declared_surface

_HEAD = """# The engines' surface

For everybody who asks what of an engine is compared. The lists are those of `adapters/surface`, which a test
compares with the installed engines: every public name that could be about rigid motion is compared
by rows of a run, outside for one of five reasons (contact, rendering, input and output, memory, another
physics), or not compared yet, with the reason. `plumbline list surface` counts the names and lists those
that the installed version has besides, as a night does.

Written by `python -m plumbline.engines.surface_page > docs/surface.md`.
"""


def surface_page() -> str:
    """Write the page.

    Returns:
        Markdown.

    """
    surfaces = [declared_surface(name) for name in SURFACES]
    lines = [_HEAD, "| engine | version | compared | not yet | outside |", "|---|---|---|---|---|"]
    for one in surfaces:
        count = one.counts()
        numbers = (str(count[status]) for status in (COMPARED, "not yet", "outside"))
        lines.append(f"| {one.engine} | {one.version} | {' | '.join(numbers)} |")
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
        for detail, names in sorted(details.items()):
            yield f"- {detail}: {', '.join(f'`{name}`' for name in names)}"


if __name__ == "__main__":
    print(surface_page(), end="")
