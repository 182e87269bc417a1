"""Check the shapes and types of arrays at every call of the packages' functions and dataclasses.

An annotation as ``Float[Array, "bodies 3"]`` holds for arguments, results and fields; a word is one size in
all annotations of a function.  Other annotations are mypy's.  Processes that a test starts check nothing.
"""

import re
import sys
from functools import wraps
from importlib.machinery import PathFinder, SourceFileLoader
from inspect import isfunction
from types import FunctionType

from beartype import beartype
from jaxtyping import AbstractDtype, Bool, Int, Shaped, jaxtyped


class Float(AbstractDtype):
    """Double and extended precision."""

    dtypes = ("float64", "longdouble")


TYPES = {"Bool": Bool, "Float": Float, "Int": Int, "Shaped": Shaped}

# Tests whose calls are checked; the others are to follow, folder by folder.
CHECKED_TESTS = ("architecture", "model")
PACKAGES = ("plumbline.model", "reference_impl")
# A sum over all axes is a NumPy number and no array, so results of any shape are not checked.
SHAPE = re.compile(r'\b(Float|Int|Bool|Shaped)\[\w+, (["\'])(?!\.\.\.["\']).+?\2\]')

is_active = False


def is_checked(module):
    return any(module == package or module.startswith(f"{package}.") for package in PACKAGES)


def activate(folder):
    """Check calls from now on if tests of the folder are checked."""
    global is_active
    is_active = folder in CHECKED_TESTS


def checked(function, names):
    """The same function, with checks if it has annotations of arrays; ``names`` are those of its module."""
    texts = {name: getattr(a, "__forward_arg__", a) for name, a in function.__annotations__.items()}
    shapes = {name: eval(text, names | TYPES) for name, text in texts.items() if SHAPE.search(str(text))}
    if not shapes:
        return function
    inner = FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    inner.__kwdefaults__, inner.__annotations__ = function.__kwdefaults__, shapes
    inner.__qualname__, inner.__module__ = function.__qualname__, function.__module__
    inner = beartype(inner)

    @wraps(function)
    def call(*arguments, **named):
        if not is_active:
            return function(*arguments, **named)
        with jaxtyped("context"):
            return inner(*arguments, **named)

    return call


def check_members(owner, names):
    """Replace the functions of a module or class by checked ones."""
    for name, value in list(vars(owner).items()):
        if isfunction(value) and value.__module__ in (names["__name__"], f"namedtuple_{owner.__name__}"):
            found = checked(value, names)
        elif isinstance(value, staticmethod | classmethod) and isfunction(value.__func__):
            found = type(value)(checked(value.__func__, names))
        elif isinstance(value, property) and isfunction(value.fget):
            found = property(checked(value.fget, names), value.fset, value.fdel, value.__doc__)
        else:
            continue
        setattr(owner, name, found)


class CheckingLoader(SourceFileLoader):
    def exec_module(self, module):
        super().exec_module(module)
        names = vars(module)
        for value in list(names.values()):
            if isinstance(value, type) and value.__module__ == module.__name__:
                check_members(value, names)
        check_members(module, names)


class CheckingFinder:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if not is_checked(name):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = CheckingLoader(spec.loader.name, spec.loader.path)
        return spec


def install():
    """Check the packages that are imported from now on."""
    loaded = [name for name in sys.modules if is_checked(name)]
    assert not loaded, f"imported before their arrays can be checked: {loaded}"
    sys.meta_path.insert(0, CheckingFinder)
