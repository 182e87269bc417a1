"""Model files and descriptions of importer columns for tests that call them in this process."""

from __future__ import annotations

import mujoco

from plumbline.engines.adapter import EngineInfo
from plumbline.engines.importer_calls import read_model_file
from plumbline.model_files.model_rows import FileResult, certify_file, judge_importer
from plumbline.model_files.prepared_file import prepare_file

MUJOCO = EngineInfo("mujoco", "MuJoCo", mujoco.__version__, ())


def prepared_file(folder, text, **options):
    """The path of a file that has the text, and the file as it is prepared for importers."""
    path = folder / ("robot.urdf" if "<robot" in text else "robot.xml")
    path.write_text(text)
    return str(path), prepare_file(str(path), folder, **options)


def read_by_mujoco(prepared):
    """The file as its neutral model, for MJCF by MuJoCo, which defines it."""
    return prepared.neutral_model(read_model_file("mujoco", prepared.file))


def judge_file(shown, model, column, state_count):
    """Judge one importer's answer about a file, in this process."""
    truth = certify_file(shown, model, state_count, None)
    rows, explanation = judge_importer(shown, model, column, state_count, None, truth)
    explanations = {column[0]: explanation} if explanation else {}
    return FileResult(shown, model, tuple(rows), explanations, truth.poses, {column[0]: column[2]})
