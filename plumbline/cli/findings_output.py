"""What the terminal shows of a run: findings first, three lines each, then one line per family."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

from rich.markup import escape

from plumbline.cli.verdict_matrix import VERDICT_COLOURS
from plumbline.judging.findings import Finding
from plumbline.judging.known_issue_text import entry_lines, entry_of
from plumbline.judging.known_issues import KnownIssue
from plumbline.judging.rows import CHECKED, SHOWN_STYLES, Row, Verdict, shown_verdict
from plumbline.scenario.line_and_column_errors import shorten

WIDTH = 80  # columns, in a pipe and of lines that cut what does not fit
MAX_REASON = 2000  # characters of what an engine raised
MAX_FINDINGS = 20  # written out; the report has all


def describe_run(
    rows: Sequence[Row], findings: Sequence[Finding], width: int, verdict_count: Mapping[Verdict, int]
) -> Iterator[str]:
    """Describe findings and families, in rich markup.

    Args:
        rows: of the run.
        findings: of `find_findings`.
        width: of the lines, in columns; at least `WIDTH`, so that names stay whole.
        verdict_count: rows of random scenarios that are only counted.

    """
    width = max(width, WIDTH)
    new = [f for f in findings if f.needs_attention and f.verdict != Verdict.HARNESS_FAILED]
    for finding in new[:MAX_FINDINGS]:
        yield from finding_lines(finding, width)
    if len(new) > MAX_FINDINGS:
        yield f"… and {len(new) - MAX_FINDINGS} more findings: the report has all"
    if new:
        yield "[dim]plumbline explain NAME prints everything that is known about one[/]"
    for finding in findings:
        if not finding.needs_attention:
            yield recorded_line(finding, width)
    yield from family_lines(rows, width, verdict_count)


def finding_lines(finding: Finding, width: int) -> list[str]:
    """Describe a finding that nothing expects in three lines; of what failed the whole reason.

    The versions are beside the name, or on the last line where that has no room for them.
    """
    style, colour = SHOWN_STYLES[finding.verdict], VERDICT_COLOURS[finding.verdict]
    ratio, versions, head = finding.largest_ratio, finding.version_range, finding.name
    sizes = ("",) if ratio is None else (f", up to {ratio:.2g} times the tolerance", f", {ratio:.0e} × tol.")
    last = [coverage(finding) + size for size in sizes] + [_count_rows(finding) + sizes[-1]]
    if versions and len(f"{head}  {versions}") <= width - 2:
        head = f"{head}  {versions}"
    elif versions:
        last = [f"{versions}: {text}" for text in last]
    sentence = [shorten(f"  {finding.sentence}", width)]
    if finding.verdict == Verdict.FAILED:
        sentence = wrap(shorten(finding.sentence, MAX_REASON), width, "  ")
    return [
        f"[{colour}]{style.glyph} {escape(shorten(head, width - 2))}[/]",
        *map(escape, sentence),
        escape(_fitting([f"  {text}" for text in last], width)),
    ]


def recorded_line(finding: Finding, width: int) -> str:
    """Describe a recorded finding in one line: in fewer words where the whole is too long."""
    shown, ratio = shown_verdict(finding.verdict, finding.known_issue), finding.largest_ratio
    size, short = ("", "") if ratio is None else (f", up to {ratio:.2g} × tolerance", f", {ratio:.0e} × tol.")
    rows = _count_rows(finding)
    texts = [f"{finding.name}: {x}" for x in (coverage(finding) + size, rows + size, rows + short)]
    return f"[dim]{SHOWN_STYLES[shown].glyph} {escape(_fitting(texts, width - 2))}[/]"


def _fitting(texts: Sequence[str], width: int) -> str:
    """The first text that fits, else the last one, cut."""
    return next((text for text in texts if len(text) <= width), shorten(texts[-1], width))


def coverage(finding: Finding) -> str:
    """Say which rows a finding has: "4 rows, four-bar and 2 more"."""
    scenarios = finding.scenarios
    more = f" and {len(scenarios) - 1} more" if len(scenarios) > 1 else ""
    return f"{_count_rows(finding)}, {scenarios[0]}{more}"


def _count_rows(finding: Finding) -> str:
    count = len(finding.rows)
    return f"{count} {'row' if count == 1 else 'rows'}"


def family_lines(rows: Iterable[Row], width: int, verdict_count: Mapping[Verdict, int]) -> Iterator[str]:
    """Count scenarios and verdicts of each family."""
    counts: dict[str, Counter[str]] = {}
    scenarios: dict[str, set[str]] = {}
    for row in rows:
        shown = shown_verdict(row.verdict, row.known_issue)
        counts.setdefault(row.family, Counter())[shown] += 1
        scenarios.setdefault(row.family, set()).add(row.scenario)
    if verdict_count:
        counts.setdefault("random", Counter()).update({str(v): n for v, n in verdict_count.items()})
    longest = max(map(len, counts), default=0)
    for family, found in counts.items():
        number = len(scenarios.get(family, ()))
        text = f"{family:{longest}}  {number:3} {'scenario ' if number == 1 else 'scenarios'}"
        parts = [f"{style.glyph} {found[word]:,}" for word, style in SHOWN_STYLES.items() if found[word]]
        yield escape(shorten("  ".join([text, *parts]), width))


def legend(found: Iterable[Row]) -> list[str]:
    """List the glyphs that a run shows, with their words."""
    shown = {shown_verdict(row.verdict, row.known_issue) for row in found}
    return [f"{style.glyph} {word}" for word, style in SHOWN_STYLES.items() if word in shown]


def explain(
    finding: Finding, issue: KnownIssue | None, scripts: Mapping[str, str], width: int, own_command: str
) -> Iterator[str]:
    """Describe everything that is known about a finding, in plain text.

    Args:
        own_command: that made the results, where the smallest scenario is of a user's file; else empty.

    """
    yield finding.name
    yield from wrap(f"{finding.engine} {finding.version_range}: {finding.title}", width, "  ")
    yield from wrap(finding.sentence, width, "  ")
    if finding.known_issue and issue is None:
        yield "  recorded in a file of known issues: --known FILE prints the entry"
    if issue is not None:
        yield ""
        yield f"recorded as {finding.known_issue}:"
        yield from wrap(issue.explanation, width, "  ")
        yield from wrap(f"Evidence: {issue.evidence}", width, "  ")
        if issue.since:
            yield f"  Since version {issue.since}."
    if finding.cause is not None and finding.cause.equal:
        yield ""
        yield "The data do not distinguish this from:"
        for other in finding.cause.equal:
            yield from wrap(" ".join((other.term, other.place, other.change)), width, "  ")
    yield ""
    yield f"{coverage(finding)}; smallest scenario first:"
    for row in finding.rows:
        ratio = "" if row.ratio is None else f"  {row.ratio:.3g} × tolerance"
        yield f"  {row.style.glyph} {row.key}{ratio}"
    smallest = finding.rows[0]
    if smallest.reason != finding.sentence:
        yield ""
        yield from wrap(f"In {smallest.scenario}: {smallest.reason}", width, "")
    diagnosis = smallest.extra.get(CHECKED, smallest.diagnosis)  # the record is above
    if diagnosis and diagnosis != finding.sentence:
        yield from wrap(str(diagnosis), width, "")
    yield ""
    level = "state" if smallest.level == "surface" else smallest.level
    option = f" --level {level}" if level in ("state", "step", "trajectory") else ""
    catalogue = f"plumbline run {smallest.scenario} --engine {smallest.engine}{option}"
    yield f"again:  {own_command or catalogue}"
    script = next((scripts[row.key] for row in finding.rows if row.key in scripts), None)
    if script:
        yield f"script: {script}"
    if finding.needs_attention and finding.verdict != Verdict.HARNESS_FAILED:
        yield ""
        yield "To record it, write evidence and reason into this entry of a file for --known:"
        yield from entry_lines(entry_of(finding), width)


def wrap(text: str, width: int, indent: str) -> list[str]:
    """Wrap a sentence into indented lines."""
    return textwrap.wrap(
        text,
        width,
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
