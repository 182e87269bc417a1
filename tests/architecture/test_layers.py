"""The import graph follows the layout: packages import only those below them, and there is no cycle."""

import ast
import re
import sys
import tomllib
from graphlib import CycleError, TopologicalSorter

import pytest

from tests.helpers.import_graph import MODULES, OUTSIDE, PROJECT, ROOT, imports, layer, picture, syntax_tree


def test_the_picture_of_the_packages_is_today_s():
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    assert f"```mermaid\n{picture()}\n```" in page, f"docs/architecture.md needs the picture\n{picture()}"


def test_every_module_of_the_core_is_in_a_layer():
    loose = {m for m in MODULES if m.startswith("plumbline.") and layer(m) is None}
    assert loose == {"plumbline.__main__", "plumbline.layout"}


def imported_pairs(is_meant):
    """Each module that is meant with each module of the project that it imports."""
    return [(name, other) for name in MODULES if is_meant(name) for other in imports(name, at_import=False)]


def test_a_package_imports_only_packages_below_it():
    for name, imported in imported_pairs(lambda name: layer(name) is not None):
        own, other = layer(name), layer(imported)
        allowed = {"reference_impl", "plumbline"} | ({"reports"} if own == 0 else set())
        is_below = imported.split(".")[0] in allowed if other is None else other >= own
        assert is_below, f"{name} imports {imported}"


@pytest.mark.parametrize("folder", ["bench", "tools"])
def test_benchmarks_and_tools_import_no_tests(folder):
    files = list((ROOT / folder).rglob("*.py"))
    trees = {path: ast.walk(ast.parse(path.read_text(encoding="utf-8"))) for path in files}
    names = [
        (path, getattr(node, "module", None) or alias.name)
        for path, nodes in trees.items()
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    ]
    assert names and not [pair for pair in names if pair[1].split(".")[0] == "tests"]


def test_a_package_beside_the_core_imports_only_what_it_may():
    for name, imported in imported_pairs(lambda name: name.split(".")[0] in OUTSIDE):
        is_allowed = any(f"{imported}.".startswith(f"{a}.") for a in OUTSIDE[name.split(".")[0]])
        assert is_allowed or imported == "plumbline", f"{name} imports {imported}"  # for its version


def test_the_readable_reference_imports_no_fast_form():
    """What is read beside the notes is complete without what was written for speed."""
    fast = "reference_impl.fast"
    pairs = imported_pairs(lambda name: name.startswith("reference_impl.") and not name.startswith(fast))
    assert pairs and not [pair for pair in pairs if pair[1].startswith(fast)]


def test_judging_runs_no_engine():
    """Of calls to engines it imports the types of the answers; what calls engines is in measurements."""
    nodes = [n for m in MODULES if m.startswith("plumbline.judging.") for n in ast.walk(syntax_tree(m))]
    taken = {(n.module, alias.name) for n in nodes if isinstance(n, ast.ImportFrom) for alias in n.names}
    assert ("plumbline.engines.registry", "load_adapter") not in taken
    for module, member in taken:
        calling = ("plumbline.engines.engine_calls", "plumbline.processes.worker_pool")
        is_call = module in calling and member.islower()
        assert not is_call and module != "plumbline.engines.metamorphic_hooks", f"{module}.{member}"


def test_no_adapter_imports_another():
    engines = {
        m: imports(m, at_import=False) for m in MODULES if m.startswith("adapters.") and m.endswith("_engine")
    }
    for name, imported in engines.items():
        family = name.removeprefix("adapters.").split("_")[0]
        others = {m for m in imported & engines.keys() if m.removeprefix("adapters.").split("_")[0] != family}
        assert not others, f"{name} imports {others}"


def test_no_module_imports_itself_in_a_circle():
    """Also not by imports inside of functions, which only delay loading."""
    graph = {name: imports(name, at_import=False) & MODULES.keys() - {name} for name in MODULES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" → ".join(error.args[1]))


def test_the_main_job_needs_no_optional_package():
    """`make run` and the action install the dependencies without groups: what they load may need no more."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = project["dependencies"] + project["optional-dependencies"]["all"]
    names = {re.split(r"[\s;><=~\[]", need)[0].lower() for need in declared}
    own = {"ruamel.yaml": "ruamel", "pin": "pinocchio"}
    allowed = {own.get(name, name) for name in names} | set(sys.stdlib_module_names) | set(PROJECT)
    allowed |= {"annotated_types", "markupsafe", "pydantic_core"}  # which those install
    optional = {}
    for name in (
        m for m in MODULES if m.split(".")[0] in ("plumbline", "reports", "adapters", "reference_impl")
    ):
        body = syntax_tree(name).body
        found = {a.name for node in body if isinstance(node, ast.Import) for a in node.names}
        found |= {node.module for node in body if isinstance(node, ast.ImportFrom)}
        if foreign := {module.split(".")[0] for module in found} - allowed:
            optional[name] = foreign
    users = {name: imports(name, at_import=True) & optional.keys() for name in MODULES}
    users = {name: found for name, found in users.items() if found and name not in optional}
    assert not users, "load them where they are used, with a sentence where they are missing"
    assert "plumbline.processes.dask_cluster" in optional
    assert not optional.keys() & {"plumbline.storage.history_of_nights", "reports.earlier_runs"}
