"""The source that a call executes, as one file: adapters' own functions without what the call did not reach.

A call is traced, line by line, in the packages of this project.  Of each function that it executed the
statements it reached are kept as they stand in the file, without types; so are the classes and constants that
these need, in the order of imports.  A function that is named but was not called becomes one that does
nothing.  What is left imports the engine, NumPy and the standard library.
"""

from __future__ import annotations

import ast
import builtins
import pickle
import re
import sys
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any

import plumbline
from plumbline.layout import ROOT

PACKAGES = ("adapters", "plumbline", "reference_impl")
GENERIC = ("dict", "list", "set", "defaultdict", "ContextVar")
NOT_CALLED = """\
def not_called(*_, **__):
    pass
"""
NAMED_ONLY = """\
(
{names},
) = [not_called] * {count}
"""  # functions that are named only
WIDTH = 96  # characters
_BARE = (ast.Pass, ast.Break, ast.Continue, ast.Global, ast.Nonlocal)  # the tracer may pass over these
_BLOCKS = ("body", "orelse", "finalbody")
Lines = dict[str, set[int]]  # by file those that were executed
Place = tuple[str, str]  # a module and a name in it


def executed_lines(module: str, function: str, arguments: bytes) -> Lines:
    """Call a function, and return the lines of this project that were executed, imports included.

    To be called in a process that has imported nothing else: what is remembered or imported is not executed.

    Args:
        arguments: pickled.

    """
    found: Lines = defaultdict(set)
    roots = (f"{ROOT / 'adapters'}/", f"{ROOT / 'reference_impl'}/", f"{Path(plumbline.__file__).parent}/")

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        path = frame.f_code.co_filename
        if not path.startswith(roots):
            return None
        if event == "line":
            found[path].add(frame.f_lineno)
        return trace

    sys.settrace(trace)
    try:
        getattr(import_module(module), function)(*pickle.loads(arguments))
    finally:
        sys.settrace(None)
    return dict(found)


@dataclass
class _Module:
    """A module of this project, and what of it is kept."""

    name: str
    lines: set[int]
    kept: dict[int, str] = field(default_factory=dict)  # text of statements, by their first line

    @cached_property
    def source(self) -> bytes:
        """The file, in whose bytes the columns of the syntax tree count."""
        with open(str(import_module(self.name).__file__), "rb") as file:
            return file.read()

    @cached_property
    def starts(self) -> list[int]:
        """Where each line starts."""
        starts = [0]
        for line in self.source.splitlines(keepends=True):
            starts.append(starts[-1] + len(line))
        return starts

    @cached_property
    def bound(self) -> dict[str, ast.stmt]:
        """By name the statement of the module that binds it."""
        found: dict[str, ast.stmt] = {}
        for one in ast.parse(self.source).body:
            for name in _bound_names(one):
                found[name] = one
        return found

    def span(self, node: Any) -> tuple[int, int]:
        """Where a part of the tree begins and ends."""
        return (self.starts[node.lineno - 1] + node.col_offset,
                self.starts[node.end_lineno - 1] + node.end_col_offset)  # fmt: skip

    def is_executed(self, node: Any) -> bool:
        """Whether a line of a statement, or of the body of a function, was executed."""
        parts: list[Any] = node.body if isinstance(node, ast.FunctionDef | ast.ClassDef) else [node]
        return any(line in self.lines for x in parts for line in range(x.lineno, x.end_lineno + 1))


def _bound_names(statement: ast.AST) -> Iterator[str]:
    match statement:
        case ast.FunctionDef() | ast.ClassDef():
            yield statement.name
        case ast.alias():
            yield statement.asname or statement.name.partition(".")[0]
        case ast.Name(ctx=ast.Store()):
            yield statement.id
        case ast.comprehension():  # binds names of its own
            pass
        case _:
            for child in ast.iter_child_nodes(statement):
                yield from _bound_names(child)


class SourceSlice:
    """The statements of this project that names need, of which only executed lines are kept."""

    def __init__(self, lines: Lines, wanted: Sequence[Place], keys: Iterable[str], table: str) -> None:
        """Collect what the wanted names need.

        Args:
            lines: that were executed, by file.
            wanted: the modules and names that the script begins with.
            keys: of tables the entries that are kept, where there are such.
            table: name of a tuple of which those elements are kept that have one of these keys.

        """
        self._lines, self._keys, self._table = lines, set(keys), table
        self._modules: dict[str, _Module] = {}
        self._imports: dict[str, None] = {}
        self._empty: set[str] = set()  # names of functions that do nothing
        self._homes: dict[str, Place] = {}  # by name in the script what it is
        self._names: dict[Place, str] = {}  # and the other way round
        self._attributes = set[str]()
        for path, numbers in lines.items():
            self._attributes |= set(_attributes(ast.parse(Path(path).read_bytes()), numbers))
        for place in wanted:
            self.name_of(*place)

    @property
    def imports(self) -> list[str]:
        """The imports, sorted."""
        return sorted(self._imports, key=lambda line: (line.startswith("from"), line))

    @property
    def code(self) -> str:
        """All that is kept."""
        names = textwrap.indent(textwrap.fill(", ".join(sorted(self._empty)), WIDTH), "    ")
        head = [NOT_CALLED] + ([NAMED_ONLY.format(names=names, count=len(self._empty))] if names else [])
        kept = [self._modules[name].kept for name in self._in_order()]
        parts = [*head, *(text for one in kept for _, text in sorted(one.items()))]
        return "".join(part if part.count("\n") == 1 else f"\n{part}\n" for part in parts)

    def _in_order(self) -> Iterator[str]:
        """The modules, each after those that it imports."""
        seen = set[str]()

        def visit(name: str) -> Iterator[str]:
            if name in seen or name not in self._modules:
                return
            seen.add(name)
            for node in self._modules[name].bound.values():
                if isinstance(node, ast.ImportFrom):
                    for one in (str(node.module), *(f"{node.module}.{x.name}" for x in node.names)):
                        yield from visit(one)
            yield name

        for name in sorted(self._modules):
            yield from visit(name)

    def _module(self, name: str) -> _Module:
        if name not in self._modules:
            path = str(import_module(name).__file__)
            self._modules[name] = _Module(name, self._lines.get(path, set()))
        return self._modules[name]

    def name_of(self, module_name: str, name: str) -> str:
        """Keep what a name of a module stands for; return its name in the script."""
        place = module_name, name
        if place in self._names:
            return self._names[place]
        module = self._module(module_name)
        statement = module.bound[name]
        if isinstance(statement, ast.ImportFrom) and (home := str(statement.module)).startswith(PACKAGES):
            self._names[place] = self.name_of(home, _alias_of(statement, name).name)
            return self._names[place]
        if isinstance(statement, ast.Import | ast.ImportFrom):
            self._imports[_import_of(statement, name)] = None
            self._names[place] = name
            return name
        flat = name
        if self._homes.setdefault(name, place) != place:
            flat = f"{name}_of_{module_name.rpartition('.')[2]}"
        for bound in _bound_names(statement):
            self._names[module_name, bound] = flat if bound == name else bound
        if isinstance(statement, ast.FunctionDef) and not module.is_executed(statement):
            self._empty.add(flat)
        else:
            self._keep(module, statement, name, flat)
        return flat

    def _keep(self, module: _Module, statement: ast.stmt, name: str, flat: str) -> None:
        text = self._read_table(module, statement, name) or _Cut(module, statement, self._attributes).text
        tree, here = (
            ast.parse(text),
            {x for x in module.bound if x != name and not self._submodule(module, x)},
        )
        edits = list[tuple[int, int, str]]()
        places = _Module(module.name, set())
        places.source = text.encode()
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                if other := self._submodule(module, node.value.id):
                    edits.append((*places.span(node), self.name_of(other, node.attr)))
            elif isinstance(node, ast.Name) and node.id in here:
                edits.append((*places.span(node), self.name_of(module.name, node.id)))
        text = _edited(places.source, edits)
        if flat != name:
            text = re.sub(rf"\b{name}\b", flat, text)
        module.kept[statement.lineno] = text

    def _read_table(self, module: _Module, statement: ast.stmt, name: str) -> str:
        """A table of which few entries are kept: a constant that is read from a file, as a literal."""
        if not isinstance(statement, ast.Assign | ast.AnnAssign):
            return ""
        if name == self._table and isinstance(statement.value, ast.Tuple):
            parts = [ast.unparse(x) for x in statement.value.elts]
            wanted = [x for x in parts if any(re.search(rf"\b{re.escape(key)}\b", x) for key in self._keys)]
            return f"{name} = ({', '.join(wanted or parts)},)\n"
        start, end = module.span(statement)
        if b"read_text" not in module.source[start:end]:
            return ""
        return f"{name} = {_with_keys(getattr(import_module(module.name), name), self._keys)!r}\n"

    @staticmethod
    def _submodule(module: _Module, name: str) -> str:
        """The module of this project that a name stands for; empty where it is none."""
        statement = module.bound.get(name)
        if not isinstance(statement, ast.ImportFrom) or not str(statement.module).startswith(PACKAGES):
            return ""
        path = f"{statement.module}.{_alias_of(statement, name).name}"
        return path if path in sys.modules else ""


def _attributes(tree: ast.AST, lines: set[int]) -> Iterator[str]:
    """Attributes, keywords and texts in functions of a module, as far as they were executed.

    An attribute of `self` that is not called there is given as "self.NAME" too.
    """
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.Lambda):
            for node in ast.walk(function):
                if isinstance(node, ast.Attribute | ast.keyword | ast.Constant) and node.lineno in lines:
                    found = getattr(node, "attr", None) or getattr(node, "arg", None)
                    yield str(found or getattr(node, "value", ""))
                    if id(node) not in called and isinstance(node, ast.Attribute):
                        yield ast.unparse(node)


def _may_act(test: ast.expr) -> bool:
    """Whether a condition calls something that may do more than answer."""
    calls = [node.func for node in ast.walk(test) if isinstance(node, ast.Call)]
    return any(ast.unparse(function).partition(".")[0] not in ("np", *dir(builtins)) for function in calls)


def _is_generic(function: ast.expr) -> bool:
    """Whether a function that is called is a class with the types of what it holds."""
    owner = function.value if isinstance(function, ast.Subscript) else None
    return isinstance(owner, ast.Name) and owner.id in GENERIC


def _alias_of(statement: ast.Import | ast.ImportFrom, name: str) -> ast.alias:
    """What a statement imports under a name."""
    return next(alias for alias in statement.names if name in _bound_names(alias))


def _import_of(statement: ast.Import | ast.ImportFrom, name: str) -> str:
    """The line that imports one name."""
    alias = _alias_of(statement, name)
    origin = f"from {statement.module} " if isinstance(statement, ast.ImportFrom) else ""
    return f"{origin}import {alias.name}" + (f" as {alias.asname}" if alias.asname else "")


def _with_keys(table: Any, keys: set[str]) -> Any:
    """A table of tables with these entries alone, where it has one of them."""
    if not isinstance(table, dict):
        return table
    if found := {key: x for key, x in table.items() if key in keys}:
        return found
    return {key: _with_keys(x, keys) for key, x in table.items()}


def _edited(source: bytes, edits: Iterable[tuple[int, int, str]]) -> str:
    """Replace parts of a text; of parts that contain others the larger ones count."""
    done = len(source) + 1
    for start, end, text in sorted(edits, key=lambda x: (-x[1], x[0])):
        if end <= done:
            source = source[:start] + text.encode() + source[end:]
            done = start
    return source.decode()


def _first_line(statement: Any) -> int:
    """Where a statement begins, its decorators included."""
    lines: list[int] = [x.lineno for x in (statement, *getattr(statement, "decorator_list", ()))]
    return min(lines)


class _Cut:
    """A statement of a module without what was not executed, and without types."""

    def __init__(self, module: _Module, statement: Any, attributes: set[str]) -> None:
        self._module, self._attributes = module, attributes
        self._edits: list[tuple[int, int, str]] = []
        self._removed = set[int]()  # identities of statements
        first, last = module.starts[_first_line(statement) - 1], module.starts[statement.end_lineno]
        self._clean(statement)
        edits = [(a - first, b - first, text) for a, b, text in self._edits]
        self.text = _edited(module.source[first:last], edits)

    def _clean(self, node: Any) -> None:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and (words := ast.get_docstring(node)):
            first = node.body[0]  # its first line is enough
            self._edits.append((*self._module.span(first), f'"""{words.splitlines()[0]}"""'))
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            self._drop_types(node)
        if isinstance(node, ast.AnnAssign):
            self._drop_annotation(node)
        if isinstance(node, ast.Call) and _is_generic(node.func):  # dict[str, Any]()
            generic: Any = node.func
            self._edits.append((self._module.span(generic.value)[1], self._module.span(generic)[1], ""))
        if isinstance(node, ast.ClassDef):
            named: list[Any] = [x for x in node.body if self._is_only_named(x)]
            for method in named:
                self._edits.append((*self._module.span(method), f"{method.name} = not_called"))
            self._removed.update(map(id, named))
            self._block(node.body, [x for x in node.body if x in named or self._is_member(x)], "pass")
        elif not isinstance(node, ast.Module):
            for name in _BLOCKS:
                body = getattr(node, name, None)
                if isinstance(body, list) and body and isinstance(body[0], ast.stmt):
                    is_function = isinstance(node, ast.FunctionDef)
                    kept = [x for x in body if self._is_reached(x, is_function and x is body[0])]
                    if name == "orelse" and not any(not isinstance(x, _BARE) for x in kept):
                        self._remove(*body, after=node.body[-1])
                        continue
                    self._block(body, kept, "raise" if isinstance(node, ast.ExceptHandler) else "pass")
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.stmt) or id(child) not in self._removed:
                self._clean(child)

    def _is_only_named(self, node: Any) -> bool:
        """Whether a method was not executed, but is taken without a call."""
        is_plain = isinstance(node, ast.FunctionDef) and not node.decorator_list
        return is_plain and not self._module.is_executed(node) and f"self.{node.name}" in self._attributes

    def _is_member(self, node: Any) -> bool:
        """Whether a statement of a class is needed."""
        if isinstance(node, ast.FunctionDef):
            return self._module.is_executed(node)
        if isinstance(node, ast.Assign | ast.AnnAssign):
            is_field = isinstance(node, ast.AnnAssign) and "ClassVar" not in ast.unparse(node.annotation)
            return is_field or (bool(node.value) and not self._attributes.isdisjoint(_bound_names(node)))
        return isinstance(node, ast.Expr)

    def _is_reached(self, node: Any, is_first: bool) -> bool:
        if isinstance(node, _BARE) or (is_first and isinstance(node, ast.Expr)):
            return True
        lines = range(node.lineno, node.end_lineno + 1)
        if not any(line in self._module.lines for line in lines):
            return False
        if isinstance(node, ast.If):  # one that only asks
            inner = [*node.body, *node.orelse]
            return _may_act(node.test) or any(self._is_reached(x, is_first=False) for x in inner)
        return True

    def _block(self, body: Sequence[Any], kept: Sequence[Any], instead: str) -> None:
        """Remove statements from a block."""
        if not kept:
            start, end = self._module.span(body[0])[0], self._module.span(body[-1])[1]
            if body[0].__dict__.get("decorator_list"):
                start = self._module.span(body[0].decorator_list[0])[0] - 1
            self._edits.append((start, end, instead))
            self._removed.update(map(id, body))
            return
        for one in body:
            if not any(one is x for x in kept):
                self._remove(one)

    def _remove(self, *statements: Any, after: Any = None) -> None:
        """Remove whole lines, with comments above them, and with "else" after a statement."""
        begin = _first_line(statements[0]) if after is None else after.end_lineno + 1
        lines = self._module.source.splitlines()
        while lines[begin - 2].strip().startswith(b"#") or not lines[begin - 2].strip():
            begin -= 1
        starts = self._module.starts
        self._edits.append((starts[begin - 1], starts[statements[-1].end_lineno], ""))
        self._removed.update(map(id, statements))

    def _drop_types(self, node: ast.FunctionDef | ast.Lambda) -> None:
        every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        for one in [*every, node.args.vararg, node.args.kwarg]:
            if one is not None and one.annotation is not None:
                start = self._module.starts[one.lineno - 1] + one.col_offset + len(one.arg.encode())
                self._edits.append((start, self._module.span(one.annotation)[1], ""))
        if isinstance(node, ast.FunctionDef) and node.returns is not None:
            start, end = self._module.span(node.returns)
            arrow = self._module.source.rindex(b"->", 0, start)
            self._edits.append((arrow - 1, end, ""))

    def _drop_annotation(self, node: ast.AnnAssign) -> None:
        start, end = self._module.span(node.target)[1], self._module.span(node.annotation)[1]
        is_local = "ClassVar" in ast.unparse(node.annotation) or not self._is_in_class(node)
        self._edits.append((start, end, "" if is_local else ": object"))

    def _is_in_class(self, node: ast.AnnAssign) -> bool:
        return any(node in x.body for x in self._module.bound.values() if isinstance(x, ast.ClassDef))
