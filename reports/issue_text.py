"""The text of an issue about a finding, in the form of the engine's tracker."""

from __future__ import annotations

from reports.stored_results import Record, Results
from reports.verdicts import format_number

# What happens, what was expected, how to see it, where: the headings of the tracker's form for bugs.
HEADINGS = {
    "mujoco": ("What's happening? What did you expect?", "", "Steps for reproduction", "My setup"),
    "pinocchio": ("Bug description", "Expected behavior", "Reproduction steps", "System"),
}
OTHER_HEADINGS = ("What happens", "What is expected, and why", "To reproduce", "Versions")


def issue_text(results: Results, finding: Record) -> str:
    """Write the issue: title, what happens, the expected number and why, a script, the versions tried.

    Args:
        finding: one of ``results.findings``.

    """
    by_key = {row["key"]: row for row in results.rows}
    rows = [by_key[key] for key in finding["rows"]]
    first = rows[0]
    package = finding["engine"].partition("-")[0]
    happens, expects, how, where = HEADINGS.get(package, OTHER_HEADINGS)
    wrong = ", ".join(finding["versions"]) or "unknown"
    right = (
        f"; the same rows agree in {', '.join(finding['right_versions'])}"
        if finding["right_versions"]
        else ""
    )
    scripted = next((row for row in rows if row["key"] in results.scripts), None)
    value, ratio, tolerance = (format_number(first[name]) for name in ("value", "ratio", "tolerance"))
    expected = (
        f"The error is {value} {first['unit']}, {ratio} times what rounding explains ({tolerance} "
        f"{first['unit']}). Tolerance: {first['derivation']}."
    )
    count = len(finding["scenarios"])
    on = f"on {count} mechanisms, of which {first['scenario']} is the smallest" if count > 1 else ""
    parts = [
        f"# {finding['engine']}: {finding['title']}",
        f"## {happens}",
        f"{first['reason'][:1].upper()}{first['reason'][1:]}.",
        f"Diagnosis: {finding['sentence']}." if finding["sentence"] != first["reason"] else "",
        f"## {expects}" if expects else "",
        expected,
        f"It shows in {len(rows)} comparison{'s' * (len(rows) > 1)} {on or 'on ' + first['scenario']}.",
        f"## {how}",
    ]
    if scripted is not None:
        parts += [
            "The script stands alone; its head says what it shows.",
            f"```python\n{results.scripts[scripted['key']].rstrip()}\n```",
        ]
    else:
        is_own = results.scenarios[first["scenario"]].get("own", False)
        catalogue = f"python -m plumbline run {first['scenario']} --engine {first['engine']}"
        parts.append(f"`{results.run['command'] if is_own else catalogue}`")
    parts += [
        f"## {where}",
        f"Wrong in {wrong}{right}. Python {results.run['python']}, {results.run['platform']}.",
    ]
    return "\n\n".join(filter(None, parts))
