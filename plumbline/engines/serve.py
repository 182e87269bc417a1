"""Answer protocol 1 for a Python adapter: `plumbline serve`, in the environment of the engine."""

from __future__ import annotations

import json
import os
import sys
import time
from typing import IO

import numpy as np

from plumbline.engines.adapter import MODEL_GAPS, UNSUPPORTED_KINDS, Adapter
from plumbline.engines.protocol import QUANTITIES, VERSIONS, IntegratorAnswer, to_json
from plumbline.model.datatypes import BALL, KINDS, ROD, Model, State, Unsupported
from plumbline.model.kinematics import angular_velocity
from plumbline.processes.exceptions import describe_exception
from plumbline.processes.line_process import Message


class _Server:
    """The answers of one adapter; the mechanism of the last question `model` is kept."""

    def __init__(self, adapter: Adapter) -> None:
        self.adapter = adapter
        self.model: Model | None = None

    def hello(self, question: Message) -> Message:
        adapter = self.adapter
        gaps = {**adapter.unsupported, **adapter.gaps}
        loops = adapter.builds_trees and not adapter.loops_unsupported_reason
        has = {
            "trees": adapter.builds_trees,
            "loads": "loads" not in gaps,
            "elements": adapter.builds_elements,
            "loops": loops,
            "loop motions": adapter.moves_loops,
        }
        names, keys = IntegratorAnswer.__dataclass_fields__, {*MODEL_GAPS, *UNSUPPORTED_KINDS, *QUANTITIES}
        return {
            "protocol": max({*VERSIONS} & {*question["protocols"]}, default=VERSIONS[0]),
            "name": adapter.name,
            "title": adapter.title,
            "version": adapter.version(),
            "joints": [*KINDS] if adapter.builds_trees else [ROD, BALL],
            "quantities": [name for name in QUANTITIES if name not in adapter.unsupported],
            "integrators": [{name: getattr(one, name) for name in names} for one in adapter.integrators],
            "has": [name for name, is_there in has.items() if is_there],
            "gaps": {name: why for name, why in gaps.items() if name in keys},
        }

    def echo(self, question: Message) -> Message:
        return {"values": question["values"]}

    def mechanism(self, question: Message) -> Message:
        fields = {name: value for name, value in question["model"].items() if value != []}
        self.model = Model.from_fields(fields)
        return {}

    def evaluate(self, question: Message) -> Message:
        assert self.model is not None
        states = [_state(one) for one in question["states"]]
        found = self.adapter.evaluate(self.model, states)
        return {"answers": [{k: v for k, v in to_json(one).items() if v is not None} for one in found]}

    def simulate(self, question: Message) -> Message:
        assert self.model is not None
        times, resolution = np.array(question["times"], float), float(question["resolution"])
        state = _state(question["state"])
        run = self.adapter.simulate(self.model, state, times, question["integrator"], resolution)
        norms = np.linalg.norm(run.p, axis=-1, keepdims=True)
        omega = angular_velocity(run.p / norms, run.pdot / norms)
        return {**to_json({n: getattr(run, n) for n in ("t", "r", "p", "v")}), "omega": to_json(omega),
                "steps": int(run.steps)}  # fmt: skip


def _state(fields: Message) -> State:
    return State(**{name: np.array(value, float) for name, value in fields.items()})


def serve(adapter: Adapter, lines: IO[str], answers: IO[str]) -> None:
    """Answer questions until the input ends.

    Args:
        lines: the questions.
        answers: where the answers go.

    """
    server = _Server(adapter)
    ways = {"hello": server.hello, "echo": server.echo, "model": server.mechanism,
            "evaluate": server.evaluate, "simulate": server.simulate}  # fmt: skip
    for line in lines:
        question, begin = json.loads(line), time.process_time()
        try:
            answer = ways[question["ask"]](question)
        except Unsupported as refusal:
            answer = {"unsupported": str(refusal), "gap": refusal.gap}
        except Exception as error:  # the engine's own failure
            answer = {"error": describe_exception(error)}
        answer |= {"id": question["id"], "cpu": time.process_time() - begin}
        answers.write(json.dumps(answer, allow_nan=False) + "\n")
        answers.flush()


def serve_standard_streams(adapter: Adapter) -> None:
    """Answer on the standard output; what the engine prints goes to the standard error instead."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    serve(adapter, sys.stdin, answers)
