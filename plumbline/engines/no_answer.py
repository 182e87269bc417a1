"""Calls that an engine may refuse or fail: its answer, or a record of what it did instead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self, TypeVar

from plumbline.model.datatypes import Unsupported
from plumbline.processes.exceptions import describe_exception, place_of

T = TypeVar("T")


@dataclass(frozen=True)
class NoAnswer:
    """What an engine did in place of an answer."""

    message: str
    is_refusal: bool  # by the engine or its adapter; else a failure
    gap: str = ""  # the declared gap that the refusal follows from
    missing: str = ""  # name that the installed version lacks, where that is the reason
    place: str = ""  # `place_of` what was raised

    @classmethod
    def by(cls, error: Exception) -> Self:
        """Record what was raised, which may be anything."""
        message, place = describe_exception(error), place_of(error)
        if isinstance(error, Unsupported):
            return cls(message, True, error.gap, error.missing, place)
        return cls(message, is_refusal=False, place=place)


def attempt(call: Callable[..., T], *arguments: Any) -> T | NoAnswer:
    """Call an engine; what it raises, which may be anything, becomes a reason for the results.

    Raises:
        MemoryError: the worker reached its memory limit, which the pool reports.

    """
    try:
        return call(*arguments)
    except MemoryError:
        raise
    except Exception as error:
        return NoAnswer.by(error)
