"""Problems of input files: where they are, what is wrong, what would be valid."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

from plumbline.processes.exceptions import PlumblineError

MAX_LISTED_PROBLEMS = 100  # problems that the text of an error lists; `problems` holds them all


@dataclass(frozen=True)
class Problem:
    """One mistake in a file."""

    file: str
    line: int  # from 1; 0 where there is no position
    column: int  # from 1
    field: str  # path of the field, as `bodies[0].mass`; empty for the whole file
    message: str  # what is wrong
    valid: str = ""  # what would be valid, a noun phrase
    hint: str = ""  # how to correct it, an imperative or a likely cause

    def __str__(self) -> str:
        where = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        parts = [self.field, self.message] if self.field else [self.message]
        valid = f"; valid would be {self.valid}" if self.valid else ""
        return where + _on_one_line(": ".join(["", *parts]) + valid + (f"; {self.hint}" if self.hint else ""))


def _on_one_line(text: str) -> str:
    """Escape what a terminal would not print, and make line breaks blanks: files can hold any character."""
    shown = (c if c.isprintable() else " " if c.isspace() else ascii(c)[1:-1] for c in text)
    return text if text.isprintable() else "".join(shown)


class ScenarioError(PlumblineError, ValueError):
    """A file that cannot be used; ``problems`` has every mistake of it, the text one per line."""

    def __init__(self, problems: Iterable[Problem]):
        self.problems = tuple(sorted(problems, key=lambda p: (p.file, p.line, p.column, p.field)))
        lines = [str(problem) for problem in self.problems[:MAX_LISTED_PROBLEMS]]
        if len(self.problems) > MAX_LISTED_PROBLEMS:
            lines.append(f"… and {len(self.problems) - MAX_LISTED_PROBLEMS} more problems")
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[type[ScenarioError], tuple[tuple[Problem, ...]]]:
        return type(self), (self.problems,)


def closest_match(word: str, known: Sequence[str], cutoff: float = 0.5) -> str:
    """Find the known word that is most similar to a misspelt one; capitals do not count.

    Args:
        cutoff: the least similarity, from 0 to 1 (difflib's ratio).

    Returns:
        The known word, or an empty string where none is similar.

    """
    close = get_close_matches(word[:100].lower(), [k.lower() for k in known], n=1, cutoff=cutoff)
    return next((k for k in known if close and k.lower() == close[0]), "")


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Write the hint ``did you mean …?`` for a misspelt word.

    Returns:
        The hint, or an empty string where no known word is similar.

    """
    close = closest_match(word, known)
    return f"did you mean {close!r}?" if close else ""


def in_brackets(hint: str) -> str:
    """Write a hint that may be empty after what is wrong."""
    return f" ({hint})" if hint else ""


def nearest_or_all(word: str, known: Iterable[str]) -> str:
    """Suggest the known word that is nearest to a misspelt one, or list all of them."""
    names = list(known)
    return did_you_mean(word, names) or f"there are: {', '.join(names)}"


def first_words(words: Sequence[str], most: int, more: str = " …", separator: str = ", ") -> str:
    """List words side by side; where there are more than the most that are shown, ``more`` follows."""
    return separator.join(words[:most]) + (more if len(words) > most else "")


def shorten(text: str, limit: int = 60) -> str:
    """Cut a text that a file gives, so that a message stays readable.

    Args:
        text: any text.
        limit: the largest length of what is returned, in characters.

    Returns:
        The text, or its beginning with an ellipsis.

    """
    return text if len(text) <= limit else text[: limit - 1] + "…"
