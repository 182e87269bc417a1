"""Names that adapters declare, read from their source: also of engines that are not installed."""

from __future__ import annotations

import re
from functools import cache

from plumbline.layout import ROOT


@cache
def declared_integrators() -> frozenset[str]:
    """Collect the names of the integrators of all adapters.

    Returns:
        The first arguments of all `Integrator`s that are built in the folder of the adapters.

    """
    return frozenset(re.findall(r'\bIntegrator\(\s*"([^"]+)"', _sources()))


@cache
def declared_texts() -> frozenset[str]:
    """Collect the texts in the adapters' source: names of algorithms and solvers are among them."""
    return frozenset(re.findall(r'"([^"\\\n]+)"', _sources()))


@cache
def _sources() -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "adapters").glob("*.py")))
