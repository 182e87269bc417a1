"""Descriptions of importer columns for tests that call them in this process."""

from __future__ import annotations

import mujoco

from plumbline.engines.adapter import EngineInfo

MUJOCO = EngineInfo("mujoco", "MuJoCo", mujoco.__version__, ())
