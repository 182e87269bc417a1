"""Check public functions: docstrings begin informatively, entries add to names, and arrays have shapes.

    python -m tools.check_docstrings [PATH ...]      default: all packages

An array's shape stands in its type, ``Float[Array, "bodies 3"]``; dictionaries of arrays need none.

Public means: a module-level function or class, or a method of such a class, whose name has no leading
underscore.  No section is required.  Where there is one (Google style), each entry of ``Args`` is about a
parameter of the function and adds to its name; a description that only repeats words of the name adds
nothing.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("plumbline", "adapters", "reference_impl", "reports", "bench")
SECTIONS = ("Args", "Returns", "Yields", "Raises")
UNSHAPED = ("plumbline/truth", "plumbline/equations", "plumbline/diagnosis", "bench")  # not yet
SHAPED_TYPES = {"Float", "Int", "Bool", "Shaped", "dict", "Mapping", "Callable"}
ARRAY_TYPES = {"Array", "AnyArray", "Indices", "Flags", "NDArray", "ndarray"}
FILLER = {"the", "a", "an", "of", "to", "in", "for", "and", "this", "that", "its", "return", "returns", "is"}
FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef


def problems_in_file(path: Path) -> Iterator[str]:
    """Find the problems of the public functions and classes of one file.

    Yields:
        One message per problem, as ``file:line: name: what is missing``.

    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    needs_shapes = not path.is_relative_to(ROOT) or not path.relative_to(ROOT).as_posix().startswith(UNSHAPED)
    for node in tree.body:
        if isinstance(node, FunctionNode) and not node.name.startswith("_"):
            yield from _located(path, node, node.name, _function_problems(node, needs_shapes))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            if not ast.get_docstring(node):
                yield from _located(path, node, node.name, ["no docstring"])
            for method in node.body:
                if isinstance(method, ast.AnnAssign) and needs_shapes and _has_unshaped(method.annotation):
                    name = f"{node.name}.{ast.unparse(method.target)}"
                    yield from _located(path, method, name, ["an array without a shape"])
                if isinstance(method, FunctionNode) and not method.name.startswith("_"):
                    yield from _located(
                        path, method, f"{node.name}.{method.name}", _function_problems(method, needs_shapes)
                    )


def _located(path: Path, node: ast.AST, name: str, problems: list[str]) -> Iterator[str]:
    line = getattr(node, "lineno", 1)
    yield from (f"{path.relative_to(ROOT)}:{line}: {name}: {problem}" for problem in problems)


def _has_unshaped(annotation: ast.expr | None) -> bool:
    """Whether an annotation has an array that is in no type with a shape."""
    if isinstance(annotation, ast.Subscript) and _name(annotation.value) in SHAPED_TYPES:
        return False
    is_array = isinstance(annotation, ast.expr) and _name(annotation) in ARRAY_TYPES
    children = ast.iter_child_nodes(annotation) if annotation else ()
    return is_array or any(_has_unshaped(child) for child in children if isinstance(child, ast.expr))


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def _function_problems(node: FunctionNode, needs_shapes: bool) -> list[str]:
    decorators = {_decorator_name(decorator) for decorator in node.decorator_list}
    docstring = ast.get_docstring(node)
    if decorators & {"overload", "override"}:
        return []
    if not docstring:
        return ["no docstring"]
    if decorators & {"command", "group"}:
        return []
    summary, sections = _split_sections(docstring)
    problems: list[str] = []
    if not _informative(summary, node.name):
        problems.append("the first line repeats the name")
    arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
    if needs_shapes and any(map(_has_unshaped, (node.returns, *(a.annotation for a in arguments)))):
        problems.append("an array without a shape")
    parameters = {a.arg for a in arguments}
    parameters |= {a.arg for a in (node.args.vararg, node.args.kwarg) if a is not None}
    for name, text in _entries(sections.get("Args", "")).items():
        if name not in parameters:
            problems.append(f"Args has {name!r}, which is no parameter")
        elif not _informative(text, name):
            problems.append(f"Args repeats the name {name!r}")
    return problems


def _decorator_name(node: ast.expr) -> str:
    while isinstance(node, ast.Call):
        node = node.func
    return _name(node)


def _split_sections(docstring: str) -> tuple[str, dict[str, str]]:
    parts = re.split(rf"^({'|'.join(SECTIONS)}):\s*$", docstring, flags=re.M)
    return parts[0].strip().split("\n")[0], dict(zip(parts[1::2], parts[2::2], strict=True))


def _entries(section: str) -> dict[str, str]:
    entries: dict[str, str] = {}
    for names, text in re.findall(
        r"^ {4}(\*{0,2}\w[\w., *]*?)(?: \([^)]*\))?: (.*(?:\n {5,}.*)*)", section, re.M
    ):
        entries |= dict.fromkeys((name.strip("* ").rpartition(".")[2] for name in names.split(",")), text)
    return entries


def _informative(text: str, name: str) -> bool:
    words = set(re.findall(r"[^\W_]+", text.lower())) - FILLER
    return bool(words - set(name.lower().split("_")))


def main(arguments: list[str]) -> int:
    """Print every problem of the named files and folders.

    Args:
        arguments: paths of files or folders; all packages where empty.

    Returns:
        The exit code: 1 if there is a problem, else 0.

    """
    roots = [Path(argument).resolve() for argument in arguments] or [ROOT / package for package in PACKAGES]
    files = [
        file
        for root in roots
        for file in (sorted(root.rglob("*.py")) if root.is_dir() else [root])
        if not {"node_modules", "out"} & set(file.parts) and not file.name.startswith("test_")
    ]
    problems = [problem for file in files for problem in problems_in_file(file)]
    print("\n".join(problems) or "every public function has an informative docstring, and arrays have shapes")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
