"""Undeclared identity: two columns of a run whose answers are the same to the last bit everywhere.

Independent computations of one number differ by rounding. Two engines, or two integrators of an engine, that
give equal bits on every generic scenario of a run are one computation under two names, unless an integrator
is declared as the alias of the other (`Integrator.alias_of`) or both are versions of one engine.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.environments import split_version
from plumbline.judging.rows import RUN_FAMILY, Fingerprints, Row, RowContext, Verdict
from plumbline.model.datatypes import Array, StateQuantities, Trajectory

MIN_SCENARIOS = 3  # generic scenarios that two columns share before equal bits are an accusation
RUN_SCENARIO = "all scenarios"  # in place of a scenario's name: such a row is about the whole run
COMPARED_QUANTITIES = "acceleration", "angular_acceleration", "joint_reaction"

_Column = tuple[str, str, str]  # engine, integrator ("-" at states), quantity ("run" for integrators)


def state_fingerprints(answers: Sequence[StateQuantities]) -> Fingerprints:
    """Hash the answers of an engine at states.

    Returns:
        By quantity the hash of its bits at all states, of the quantities that the engine offers.

    """
    found: Fingerprints = {}
    for quantity in COMPARED_QUANTITIES:
        arrays = [getattr(answer, quantity) for answer in answers]
        if all(array is not None for array in arrays):
            found["-", quantity, ""] = _hash_bits(arrays)
    return found


def run_fingerprints(integrator: str, runs: Mapping[float, Trajectory]) -> Fingerprints:
    """Hash the runs of an integrator.

    Args:
        runs: trajectory by resolution.

    Returns:
        By resolution the hash of the bits of all samples.

    """
    return {
        (integrator, "run", f"{resolution!r}"): _hash_bits([run.r, run.p, run.v])
        for resolution, run in runs.items()
    }


def _hash_bits(arrays: Sequence[Array]) -> bytes:
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).digest()[:16]


class IdentityCheck:
    """Compares the columns of a run pair by pair, scenario by scenario; keeps counts only.

    Attributes:
        scenario_count: generic scenarios so far.

    """

    def __init__(self, engines: Mapping[str, EngineInfo]) -> None:
        """Start without scenarios."""
        self._engines = engines
        self._equal: Counter[tuple[_Column, _Column]] = Counter()  # scenarios with equal bits
        self._shared: Counter[tuple[_Column, _Column]] = Counter()  # scenarios that both columns answered
        self.scenario_count = 0

    def add_scenario(self, fingerprints: Mapping[str, Fingerprints]) -> None:
        """Compare the columns of one generic scenario.

        Args:
            fingerprints: by engine those of its answers.

        """
        self.scenario_count += 1
        columns: dict[_Column, dict[str, bytes]] = {}
        for engine, found in fingerprints.items():
            for (integrator, quantity, label), digest in found.items():
                columns.setdefault((engine, integrator, quantity), {})[label] = digest
        for one, other in combinations(sorted(columns), 2):
            common = columns[one].keys() & columns[other].keys()
            if one[2] == other[2] and common and not self._is_declared(one, other):
                self._shared[one, other] += 1
                self._equal[one, other] += all(columns[one][k] == columns[other][k] for k in common)

    def summary(self) -> dict[str, int]:
        """Count what was compared.

        Returns:
            Number of generic scenarios, and of pairs of columns that shared enough of them.

        """
        enough = sum(count >= MIN_SCENARIOS for count in self._shared.values())
        return {"scenarios": self.scenario_count, "pairs": enough}

    def rows(self) -> list[Row]:
        """Judge the run.

        Returns:
            A disagreement for each pair whose bits are equal on every scenario that both answered, of at
            least `MIN_SCENARIOS`; it is a row of the second column, without a scenario.

        """
        return [
            self._row(one, other, count)
            for (one, other), count in self._shared.items()
            if count >= MIN_SCENARIOS and self._equal[one, other] == count
        ]

    def _is_declared(self, one: _Column, other: _Column) -> bool:
        """Whether two columns are declared to be the same computation."""
        if one[0] != other[0]:
            return split_version(one[0])[0] == split_version(other[0])[0]
        aliases = {i.name: i.alias_of or i.name for i in self._engines[one[0]].integrators}
        return aliases.get(one[1], one[1]) == aliases.get(other[1], other[1])

    def _row(self, one: _Column, other: _Column, count: int) -> Row:
        (engine, integrator, quantity), info = other, self._engines[other[0]]
        twin = self._engines[one[0]].title if one[0] != engine else info.title
        if quantity == "run":
            what = f"every run of {info.title} with {integrator} equals that of {twin} with {one[1]}"
        else:
            what = f"the {quantity.replace('_', ' ')} of {info.title} equals that of {twin}"
        return RowContext(RUN_SCENARIO, RUN_FAMILY, engine, info.title, info.version).make_row(
            "relations", integrator, f"identity with {' '.join(part for part in one[:2] if part != '-')}",
            Verdict.DISAGREES,
            f"{what} bit for bit on all {count} generic scenarios, and no alias is declared: it is the same "
            "computation under two names",
            derivation="independent computations of one number differ by rounding",
            extra={"scenarios": count},
        )  # fmt: skip
