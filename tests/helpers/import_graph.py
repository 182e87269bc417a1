"""The project's import graph: its packages from the top down, its modules, and what each imports."""

import ast
from functools import cache
from pathlib import Path

from tests.helpers import ROOT

LAYERS = (  # from the top; a package imports only what follows it
    "cli", "conformance", "studies", "model_files", "execution", "reproduce", "storage", "judging",
    "measurements", "diagnosis", "truth", "equations", "engines", "importers", "scenario", "model",
    "processes",
)  # fmt: skip
OUTSIDE = {  # packages beside the core, and what of the project each may import
    "reference_impl": ("reference_impl",),
    "adapters": (
        "adapters", "reference_impl", "plumbline.model", "plumbline.engines", "plumbline.processes",
        "plumbline.importers.importer", "plumbline.importers.neutral_model", "plumbline.layout",
    ),
    "reports": (
        "reports", "plumbline.storage", "plumbline.judging.rows", "plumbline.model", "plumbline.processes",
    ),
    "bench": ("bench", "plumbline", "reference_impl", "adapters", "tests.helpers.random_chains"),
}  # fmt: skip
PROJECT = ("plumbline", "reference_impl", "adapters", "reports", "bench", "tests", "tools")


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules() -> dict[str, Path]:
    folders = ("plumbline", *OUTSIDE)
    files = [
        path
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        if "node_modules" not in path.parts
    ]
    return {module_name(path): path for path in files}


MODULES = modules()


@cache
def syntax_tree(name: str) -> ast.Module:
    """Of a module; not to be changed."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


@cache
def imports(name: str, *, at_import: bool) -> set[str]:
    """Modules of the project that a module imports; with at_import only those that loading it imports."""
    found = set[str]()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and at_import:
            return
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and at_import:
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively"
            members = {f"{node.module}.{alias.name}" for alias in node.names}
            found.update(members & MODULES.keys() or {str(node.module)})
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
                visit(child)

    visit(syntax_tree(name))
    return {module for module in found if module.split(".")[0] in PROJECT}


def layer(module: str) -> int | None:
    parts = module.split(".")
    return (
        LAYERS.index(parts[1]) if parts[0] == "plumbline" and len(parts) > 1 and parts[1] in LAYERS else None
    )


def package(module: str) -> str:
    """Return the package of the core, or the folder beside it, that a module is in."""
    parts = module.split(".")
    return parts[1] if layer(module) is not None else parts[0]


def picture() -> str:
    """Draw the packages as a Mermaid flowchart, without arrows that others imply."""
    shown = [*LAYERS, "adapters", "reference_impl", "reports"]
    graph = {
        name: {
            package(other)
            for module in MODULES
            if package(module) == name
            for other in imports(module, at_import=False)
        }
        & set(shown) - {name}
        for name in shown
    }
    # Adapters are loaded by their names in a table, which no import statement shows.
    below = {name: set(graph[name]) for name in shown}
    for _ in shown:
        for name in shown:
            below[name] |= {further for other in below[name] for further in below[other]}
    lines = ["flowchart TD"]
    for name in shown:
        direct = [other for other in graph[name] if not any(other in below[via] for via in graph[name])]
        lines += [f"    {name} --> {other}" for other in sorted(direct, key=shown.index)]
    return "\n".join(lines)
