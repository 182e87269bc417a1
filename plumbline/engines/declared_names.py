"""Names that adapters declare, read from their source: also of engines that are not installed."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from plumbline.layout import ROOT
from plumbline.processes.user_cache import content_key, recall, remember


@cache
def declared_integrators() -> frozenset[str]:
    """Collect the names of the integrators of all adapters.

    Returns:
        The first arguments of all `Integrator`s that are built in the folder of the adapters.

    """
    return _declared_names()[0]


@cache
def declared_texts() -> frozenset[str]:
    """Collect the texts in the adapters' source: names of algorithms and solvers are among them."""
    return _declared_names()[1]


@cache
def _declared_names() -> tuple[frozenset[str], frozenset[str]]:
    """Names of integrators, and all texts; remembered, because parsing all adapters takes a while."""
    sources = [path.read_bytes() for path in sorted((ROOT / "adapters").glob("*.py"))]
    key = content_key("adapters", Path(__file__).read_bytes(), *sources)
    found: tuple[frozenset[str], frozenset[str]] | None = recall(
        key, lambda names: all(isinstance(one, frozenset) for one in names) and len(names) == 2
    )
    if found is None:
        nodes = [node for source in sources for node in ast.walk(ast.parse(source))]
        found = _integrators(nodes), _texts(nodes)
        remember(key, found)
    return found


def _integrators(nodes: Sequence[ast.AST]) -> frozenset[str]:
    return frozenset(
        str(node.args[0].value)
        for node in nodes
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "Integrator"
        and node.args
        and isinstance(node.args[0], ast.Constant)
    )


def _texts(nodes: Sequence[ast.AST]) -> frozenset[str]:
    return frozenset(
        node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
