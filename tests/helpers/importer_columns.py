"""Descriptions of importer columns for tests that call them in this process."""

from __future__ import annotations

import mujoco

from plumbline.engines.adapter import EngineInfo
from plumbline.model_files.model_rows import FileResult, certify_file, judge_importer

MUJOCO = EngineInfo("mujoco", "MuJoCo", mujoco.__version__, ())


def judge_file(shown, model, column, state_count):
    """Judge one importer's answer about a file, in this process."""
    truth = certify_file(shown, model, state_count, None)
    rows, explanation = judge_importer(shown, model, column, state_count, None, truth)
    explanations = {column[0]: explanation} if explanation else {}
    return FileResult(shown, model, tuple(rows), explanations, truth.poses, {column[0]: column[2]})
