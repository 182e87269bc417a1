"""Names that adapters declare, read from their source: also of engines that are not installed."""

from __future__ import annotations

import ast
from functools import cache

from plumbline.engines.environments import ROOT


@cache
def declared_integrators() -> frozenset[str]:
    """Collect the names of the integrators of all adapters.

    Returns:
        The first arguments of all `Integrator`s that are built in the folder of the adapters.

    """
    return frozenset(
        str(node.args[0].value)
        for node in _adapter_nodes()
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "Integrator"
        and node.args
        and isinstance(node.args[0], ast.Constant)
    )


@cache
def declared_texts() -> frozenset[str]:
    """Collect the texts in the adapters' source: names of algorithms and solvers are among them.

    Returns:
        Every string literal.

    """
    return frozenset(
        node.value
        for node in _adapter_nodes()
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@cache
def _adapter_nodes() -> tuple[ast.AST, ...]:
    files = sorted((ROOT / "adapters").glob("*.py"))
    return tuple(node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
