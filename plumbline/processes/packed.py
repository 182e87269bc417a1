"""A value as the bytes that go to and from workers: packed once, opened only by those who look into it."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Pickled:
    """A pickled value.  Pickles are code to whoever opens them."""

    data: bytes

    @classmethod
    def of(cls, value: Any) -> Pickled:
        """The value, packed."""
        return cls(pickle.dumps(value, protocol=5))

    def load(self) -> Any:
        """The value, made anew."""
        return pickle.loads(self.data)
