"""Functions whose answers several tests share, where it is not their computing that is tested."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest.mock import patch


def by_content(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its answers kept by the content of the arguments."""
    known: dict[bytes, Any] = {}

    def call(*arguments: Any, **options: Any) -> Any:
        try:
            key = hashlib.sha256(pickle.dumps((arguments, options))).digest()
        except (AttributeError, pickle.PicklingError):  # a function among the arguments
            return function(*arguments, **options)
        if key not in known:
            known[key] = function(*arguments, **options)
        return known[key]

    return call


@contextmanager
def sharing(module: str, *names: str) -> Iterator[None]:
    """Keep the answers of functions that a module calls by these names."""
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(patch(f"{module}.{name}", by_content(getattr(import_module(module), name))))
        yield
