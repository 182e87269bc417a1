"""Calls of importers, made in worker processes: importers crash and hang.

What an importer raises becomes its refusal; what it computes is checked here, for every column alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.answers import check_numbers, check_record, check_version
from plumbline.engines.engine_calls import describe_missing
from plumbline.engines.no_answer import NoAnswer, attempt
from plumbline.engines.registry import load_importer
from plumbline.importers.importer import ModelFile, Reading
from plumbline.importers.neutral_model import CanonicalState, ModelQuantities
from plumbline.model.datatypes import EngineFailure


def describe_importer(name: str) -> EngineInfo:
    """Load an importer and describe it.

    Returns:
        Its title and version; ``missing`` is a sentence where it is not installed here, or in a version that
        the column does not support.

    Raises:
        ImportError: another module than the engine's is missing, or the engine is installed but broken.

    """
    try:
        importer = load_importer(name)
    except (ModuleNotFoundError, AttributeError) as error:
        return describe_missing(name, error, "column")
    version, missing = check_version(importer, "column")
    return EngineInfo(name, importer.title, version, (), missing)


def read_model_file(name: str, file: ModelFile) -> Reading:
    """Have an importer read a file; what it raises is its refusal.

    Returns:
        The engine's reading, or its refusal; errors are those of `attempt`.

    """
    importer = load_importer(name)
    if file.format not in importer.formats:
        return Reading(importer.version(), refusal=f"{importer.title} reads no {file.format.upper()} files")
    found = attempt(importer.read, file)
    return Reading(importer.version(), refusal=found.message) if isinstance(found, NoAnswer) else found


def read_model_files(name: str, files: Mapping[str, ModelFile]) -> dict[str, Reading]:
    """Have an importer read several files.

    Args:
        files: by any key.

    Returns:
        The readings by the same keys, as of `read_model_file`.

    """
    return {key: read_model_file(name, file) for key, file in files.items()}


def evaluate_model_file(
    name: str, file: ModelFile, states: Sequence[CanonicalState]
) -> list[ModelQuantities]:
    """Have an importer's engine compute the quantities at each state.

    Args:
        file: a file that the importer accepts.
        states: canonical states of the importer's own reading, all of the same length.

    Returns:
        One record per state.

    Raises:
        EngineFailure: an answer is missing, or has another shape, or is not finite; the message names it.
            Accelerations may be infinite: where links are massless, M may be singular.

    """
    answers = load_importer(name).evaluate(file, states)
    if len(answers) != len(states):
        raise EngineFailure(f"{name} answered {len(answers)} of {len(states)} states")
    for index, (state, answer) in enumerate(zip(states, answers, strict=True)):
        label = f"{name}, state {index}"
        check_record(answer, ModelQuantities, {"n": len(state.velocities)}, label, ("acceleration",))
        for body, pose in answer.poses.items():
            check_numbers(pose, "3 4", {}, f"{label}: pose of {body}")
    return answers
