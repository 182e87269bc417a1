"""Joint kinds are named in their table alone; other files ask its entries what a joint does."""

import ast
import re

import pytest

from reference_impl.joint_kinds import KINDS
from tests.architecture.test_layers import MODULES
from tests.helpers.import_graph import syntax_tree

OWN_TABLES = r"""
    reference_impl\.joint_kinds      # the table
    | plumbline\.truth\.certificate_(file|checker)  # certificates are checked without the code that made them
    | plumbline\.(importers|model_files)\..*  # elementary joints of robots' files
    | adapters\..*
"""
OTHER_MEANINGS = {"slide": "a motion"}
FILES = [
    name
    for name in MODULES
    if name.split(".")[0] != "reports" and not re.fullmatch(OWN_TABLES, name, re.VERBOSE)
]


def kinds_named(tree):
    """Words of kinds that stand as text by themselves, but in types and lists of bases of robots' files."""
    nodes = list(ast.walk(tree))
    types = [node for node in nodes if isinstance(node, ast.Subscript)]
    literals = [node for node in types if isinstance(node.value, ast.Name) and node.value.id == "Literal"]
    in_types = {id(constant) for node in literals for constant in ast.walk(node)}
    lists = [node.elts for node in nodes if isinstance(node, ast.List | ast.Tuple)]
    words = [[one for one in elements if isinstance(one, ast.Constant)] for elements in lists]
    of_bases = {id(one) for some in words if "fixed" in [one.value for one in some] for one in some}
    left_out = in_types | of_bases
    texts = [node for node in nodes if isinstance(node, ast.Constant) and id(node) not in left_out]
    return {node.value for node in texts if node.value in KINDS.keys() - OTHER_MEANINGS.keys()}


def test_no_file_names_a_joint_kind():
    wrong = {name: found for name in FILES if (found := kinds_named(syntax_tree(name)))}
    assert FILES and not wrong, "ask the entry of the table what the joint does"


@pytest.mark.parametrize(
    "text", ['kind == "ball"', 'kind in {"rod", "free"}', '{"cylindrical": 1}', 'f(x, "weld")']
)
def test_a_named_kind_is_found(text):
    assert kinds_named(ast.parse(text))
    assert not kinds_named(ast.parse('kind: Literal["ball"] = "a ball joint"'))
