"""Texts of the help that several commands share: examples, exit codes."""

from __future__ import annotations

from plumbline.execution.exit_codes import EXIT_CODE_MEANINGS

_EXIT_CODE_LINES = "\n".join(f"{code:5}  {meaning}" for code, meaning in EXIT_CODE_MEANINGS.items())
EXIT_CODES = f"""
\b
Exit codes:
{_EXIT_CODE_LINES}

An engine that is not installed changes no exit code, unless it was named with --engine.
"""


def examples(*lines: str) -> str:
    """Format example commands for the end of a help text.

    Args:
        *lines: what follows ``python -m plumbline``, remarks included.

    Returns:
        A paragraph whose line breaks click keeps.

    """
    return "\n".join(["\b", "Examples:", *(f"  python -m plumbline {line}" for line in lines), "", ""])
