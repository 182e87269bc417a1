"""The loop of the Python servers: questions of protocol 1 in, answers out (docs/test-your-engine.md)."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np


def rotation(p: Any) -> Any:
    """Return the rotation body → world of a unit quaternion, scalar first."""
    w, v = p[0], np.asarray(p[1:])
    return np.eye(3) + 2 * w * np.cross(np.eye(3), v) + 2 * (np.outer(v, v) - v @ v * np.eye(3))


def answer_lines(hello: dict[str, Any], build: Callable[..., Any]) -> None:
    """Answer until the input ends; what the engine prints goes to the standard error.

    Args:
        hello: the answer to `hello`.
        build: makes of the fields of a mechanism, as arrays, a function of a state that returns quantities.

    """
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    evaluate: Any = None
    for line in sys.stdin:
        question, begin, answer = json.loads(line), time.process_time(), {}
        try:
            match question["ask"]:
                case "hello":
                    answer = hello
                case "echo":
                    answer = {"values": question["values"]}
                case "model":
                    kinds = question["model"].pop("kind")
                    evaluate = build(kinds, **{k: np.array(v) for k, v in question["model"].items()})
                case "evaluate":
                    states = ({k: np.array(v) for k, v in one.items()} for one in question["states"])
                    answer = {"answers": [_plain(evaluate(**state)) for state in states]}
        except Exception as error:  # of the engine
            answer = {"error": f"{type(error).__name__}: {error}"}
        answer = {"id": question["id"], "cpu": time.process_time() - begin, **answer}
        answers.write(json.dumps(answer, allow_nan=False) + "\n")
        answers.flush()


def _plain(quantities: dict[str, Any]) -> dict[str, Any]:
    return {k: v.tolist() if isinstance(v, np.ndarray) else float(v) for k, v in quantities.items()}
