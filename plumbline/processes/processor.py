"""The processor of this machine: its name for people, and what compiled code depends on."""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

_FEATURE_KEYS = ("model", "flags", "Features", "CPU p")  # of /proc/cpuinfo; the last two: Arm


def processor_name() -> str:
    """Find the model of the processor.

    Returns:
        Its model where the system knows it, else its architecture.

    """
    models = (line.partition(":")[2].strip() for line in _cpuinfo() if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()


def processor_features() -> str:
    """Describe what machine code and the last bits of results depend on.

    Returns:
        Model and features of all cores, or the name.

    """
    lines = sorted({line for line in _cpuinfo() if line.startswith(_FEATURE_KEYS)})
    return "".join(lines) or processor_name()


@cache
def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return []
