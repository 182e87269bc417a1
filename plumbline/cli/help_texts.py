"""Texts of the help that several commands share: examples, exit codes."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import click

from plumbline.execution.exit_codes import EXIT_CODE_MEANINGS

WIDTH = 78  # of the help, less its indent
_EXIT_CODE_LINES = "\n".join(
    textwrap.fill(meaning, WIDTH, initial_indent=f"{code:5}  ", subsequent_indent=" " * 7)
    for code, meaning in EXIT_CODE_MEANINGS.items()
)
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


def command(*lines: str, session: str = "") -> Callable[[Callable[..., Any]], click.Command]:
    """Make a command whose help ends with examples and exit codes.

    Args:
        *lines: of `examples`.
        session: what a session looks like, for the end of the help.

    """
    return click.command(epilog=(examples(*lines) if lines else "") + EXIT_CODES + session)
