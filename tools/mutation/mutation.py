"""Mutation testing: small mistakes are put into the code, one at a time, and the tests have to notice each.

    python -m tools.mutation reference_impl judging           every mutant of both
    python -m tools.mutation judging --sample 300 --seed 1    300 of them, drawn at random
    python -m tools.mutation plumbline/judging/outlier.py --again   one file, earlier survivors

The mistakes are mutmut's.  Each is made in the memory of a forked child, so no file is ever changed and a
mutant costs the tests it meets and little more.  The tests run in a copy of the checkout, first once in full
to learn which test reaches which line; a mutant meets those that reach its line, the likeliest to notice
first, until one fails or `PATIENCE` ends.  docs/measurements/mutation.md says what is left out, and why.

Ends with 1 where fewer than 95 % are noticed, where one survives that `survivors.yaml` does not list with a
reason, or where one is noticed that it lists.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import inspect
import itertools
import json
import keyword
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import IO, Any, NoReturn

import coverage
import libcst as cst
import pytest
from libcst.helpers import get_full_name_for_node
from libcst.metadata import CodeRange, MetadataWrapper, ParentNodeProvider, PositionProvider
from mutmut.mutation.mutators import mutation_operators

from tools.mutation.survivors import SURVIVORS_FILE, MutantKey, load_survivors

MIN_MUTATION_SCORE = 0.95  # of the mutants have to be noticed
TEST_TIME_BUDGET = (
    8.0  # s of processor time, undisturbed, of a file's own tests that a mutant meets, and of others
)
MEMORY_LIMIT = 8 * 2**30  # bytes of address space of a child
EXIT_LATE_TEST, EXIT_NOT_TRIED = 253, 254  # exit codes of a child, see `Limit` and `Swaps`
MARKS = "slow or not full"  # without the long forms
PYTEST_PLUGINS = ("no:cacheprovider", "pytest_timeout", "_hypothesis_pytestplugin")  # others only take time
TARGETS = {
    "reference_impl": ["reference_impl/**/*.py"],
    "judging": [
        *(
            f"plumbline/judging/{name}.py"
            for name in (
                "identity",
                "invariant_drift",
                "known_issues",
                "long_runs",
                "outlier",
                "refinement_analysis",
                "relation_rows",
                "smallest_detectable_mistake",
                "state_level",
                "step_level",
                "trajectory_level",
            )
        ),
        *(
            f"plumbline/measurements/{name}.py"
            for name in (
                "long_run_study",
                "order_and_limit",
                "refinement_study",
                "*relations",
                "single_steps",
            )
        ),
        *(
            f"plumbline/truth/{name}.py"
            for name in ("ground_truth", "rounding_bound", "predictability_horizon")
        ),
        *(f"plumbline/diagnosis/{name}.py" for name in ("diagnose", "fit")),
        "plumbline/model/invariants.py",
    ],
    "checker": [f"plumbline/truth/{name}.py" for name in ("certificate_checker", "certificate_file")],
    "prover": ["plumbline/truth/certificate_proof.py"],
    "equations": ["plumbline/equations/*.py", "plumbline/truth/definition.py"],
}
TEST_FILES = {  # by target or top folder, the tests that must notice its mutants
    "reference_impl": [
        "tests/reference_impl/test_*.py",
        "tests/adapters/test_reference_engine.py",
        "tests/scenario/test_loop_files.py",
        *(f"tests/truth/test_{name}.py" for name in ("certified_tree", "loop_motion", "tree_motion")),
    ],
    "plumbline": [
        *(
            f"tests/judging/test_{name}.py"
            for name in (
                "identity",
                "known_issues",
                "long_runs",
                "outlier",
                "smallest_detectable_mistake",
                "state_level",
                "step_level",
                "trajectory*",
            )
        ),
        *(
            f"tests/measurements/test_{name}.py"
            for name in ("order_and_limit", "refinement_study", "relation*")
        ),
        *(
            f"tests/truth/test_{name}.py"
            for name in ("ground_truth", "rounding_bound", "predictability_horizon")
        ),
        "tests/diagnosis/test_diagnose.py",
        "tests/model/test_invariants.py",
        "tests/execution/test_planted_defects.py",
    ],
    "checker": ["tests/truth/test_certificate_checker.py", "tests/truth/test_certificate_file.py"],
    "prover": ["tests/truth/test_certificate_proof.py"],
    "equations": [
        "tests/equations/test_*.py",
        *(
            f"tests/truth/test_{name}.py"
            for name in ("definition", "rounding_bound", "certified_state", "certified_tree")
        ),
        *(f"tests/diagnosis/test_{name}.py" for name in ("diagnose", "force_location", "prediction")),
        "tests/judging/test_step_level.py",
    ],
}
TOKEN = re.compile(r"\"[^\"]*\"|'[^']*'|\w+\.?\w*|[^\w\s]+")
LiveFunctions = dict[tuple[str, int], list[FunctionType]]  # functions of a file by name and first line


# --- mutants ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mutant:
    """One mistake in one file."""

    file: str
    line: int
    statement_lines: tuple[int, int]  # lines of which a test must run one to reach the mutant
    was: str
    now: str
    code: str
    function: str  # qualified name of the function or class that contains it; "" at module level
    change: str  # the tokens that differ, without identifiers, as "+ → -"
    occurrence: int  # counts equal changes in one function from 1

    @property
    def key(self) -> MutantKey:
        """The name in `survivors.yaml`, independent of lines and of identifiers."""
        return self.file, self.function, self.change, self.occurrence


def is_text(node: cst.CSTNode | None) -> bool:
    """Whether a node is words for people: a string with a blank and three letters of a word."""
    if isinstance(node, cst.SimpleString):
        return bool(re.search(r"\s", node.value) and re.search(r"[a-z]{3}", node.value))
    if isinstance(node, cst.FormattedString):
        words = "".join(part.value for part in node.parts if isinstance(part, cst.FormattedStringText))
        return bool(re.search(r"\s", words) and re.search(r"[a-z]{3}", words))
    if isinstance(node, cst.ConcatenatedString):
        return is_text(node.left) or is_text(node.right)
    return False


def is_type_alias(node: cst.CSTNode) -> bool:
    """Whether a node assigns a type, as ``NDArray[…]``."""
    value = node.value if isinstance(node, cst.Assign) else None
    names = ("NDArray", "np.ndarray", "Callable", "Literal")
    return isinstance(value, cst.Subscript) and get_full_name_for_node(value) in names


def removed_argument(before: cst.Call, after: cst.Call) -> cst.Arg | None:
    """The argument that a mutated call has no longer, or has as None."""
    for i, arg in enumerate(before.args):
        if i >= len(after.args) or after.args[i] is not arg:
            return arg
    return None


def is_relevant_mutation(node: cst.CSTNode, mutated: cst.CSTNode) -> bool:
    """False for mutants of what has no behaviour: texts for people, types, `strict` of zip, warnings."""
    if is_text(node):
        return False
    if isinstance(node, cst.SimpleString) and isinstance(mutated, cst.SimpleString) and "->" in node.value:
        return mutated.value.lower() != node.value  # einsum knows its indices by any letter
    if isinstance(node, cst.Assign | cst.AnnAssign):
        return not is_text(node.value)
    if isinstance(node, cst.Call) and isinstance(mutated, cst.Call):
        arg = removed_argument(node, mutated)
        function = node.func.attr.value if isinstance(node.func, cst.Attribute) else ""
        function = node.func.value if isinstance(node.func, cst.Name) else function
        if arg is None or function in ("cast", "errstate"):
            return function not in ("cast", "errstate")
        return not is_text(arg.value) and not (arg.keyword and arg.keyword.value == "strict")
    return True


@dataclass(frozen=True)
class Mutation:
    """One replacement of one node of a module."""

    node: cst.CSTNode
    place: CodeRange
    mutated: cst.CSTNode
    statement_lines: tuple[int, int]
    function: str


class MutantFinder(cst.CSTVisitor):
    """Every mistake that mutmut's operators make in one file."""

    METADATA_DEPENDENCIES = (PositionProvider, ParentNodeProvider)

    def __init__(self) -> None:
        self.found: list[Mutation] = []

    def on_visit(self, node: cst.CSTNode) -> bool:
        """Gather the node's mutants; False where nothing inside of it is looked at."""
        if isinstance(node, cst.Annotation | cst.Decorator | cst.Import | cst.ImportFrom | cst.Assert):
            return False
        if is_type_alias(node):
            return False
        if isinstance(node, cst.Expr) and isinstance(node.value, cst.SimpleString | cst.ConcatenatedString):
            return False  # a docstring
        if isinstance(node, cst.Arg) and node.keyword and node.keyword.value == "strict":
            return False
        for kind, operator in mutation_operators:
            if isinstance(node, kind):
                place = self.get_metadata(PositionProvider, node)
                self.found += [
                    Mutation(node, place, mutated, self.statement_lines_of(node), self.function_of(node))
                    for mutated in operator(node)
                    if is_relevant_mutation(node, mutated)
                ]
        return True

    def function_of(self, node: cst.CSTNode) -> str:
        """Return the qualified name of the function or class around a node."""
        names: list[str] = []
        around: Any = node
        while not isinstance(around, cst.Module):
            around = self.get_metadata(ParentNodeProvider, around)
            if isinstance(around, cst.FunctionDef | cst.ClassDef):
                names.append(around.name.value)
        return ".".join(reversed(names))

    def statement_lines_of(self, node: cst.CSTNode) -> tuple[int, int]:
        """The lines of the node's statement; of a compound one, up to the node."""
        around: Any = node
        while not isinstance(around, cst.SimpleStatementLine | cst.BaseCompoundStatement):
            around = self.get_metadata(ParentNodeProvider, around)
        end = around if isinstance(around, cst.SimpleStatementLine) else node
        first, last = (self.get_metadata(PositionProvider, x) for x in (around, end))
        return first.start.line, last.end.line


def find_mutants(files: Sequence[str], sample: int | None, seed: int) -> list[Mutant]:
    """All mutants of the files, or ``sample`` of them drawn with ``seed``."""
    candidates = []
    for file in files:
        wrapper = MetadataWrapper(cst.parse_module(Path(file).read_text(encoding="utf-8")))
        finder = MutantFinder()
        wrapper.visit(finder)
        seen: Counter[tuple[str, str]] = Counter()
        for mutation in finder.found:
            texts = [wrapper.module.code_for_node(node) for node in (mutation.node, mutation.mutated)]
            change = changed_tokens(*texts)
            seen[mutation.function, change] += 1
            occurrence = seen[mutation.function, change]
            candidates.append((file, wrapper.module, mutation, change, occurrence))
    print(f"{len(candidates)} mutants in {len(files)} files", flush=True)
    if sample is not None:
        chosen = random.Random(seed).sample(range(len(candidates)), min(sample, len(candidates)))
        candidates = [candidates[i] for i in sorted(chosen)]
    made = []
    for file, module, mutation, change, occurrence in candidates:
        mutated = mutation.mutated
        if isinstance(mutated, cst.BaseExpression):
            mutated = mutated.with_changes(lpar=(), rpar=())  # the replaced range excludes its parentheses
        code = splice(module.code, mutation.place, module.code_for_node(mutated))
        was, now = changed_lines(module.code.splitlines(), code.splitlines())
        try:
            compile(code, file, "exec")
        except SyntaxError:
            continue
        if was or now:
            line, lines = mutation.place.start.line, mutation.statement_lines
            made.append(Mutant(file, line, lines, was, now, code, mutation.function, change, occurrence))
    return made


def changed_tokens(before: str, after: str) -> str:
    """Describe a mutation by the tokens that differ, with ``_`` for every identifier.

    Renaming a variable or reformatting a line leaves the description as it is.
    """
    one, other = (
        [
            "_" if re.fullmatch(r"[^\W\d]\w*", token) and not keyword.iskeyword(token) else token
            for token in tokens
        ]
        for tokens in (TOKEN.findall(before), TOKEN.findall(after))
    )
    first = len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False))))
    one, other = one[first:], other[first:]
    ends = zip(reversed(one), reversed(other), strict=False)
    last = len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], ends)))
    return f"{' '.join(one[: len(one) - last])} → {' '.join(other[: len(other) - last])}".strip()


def splice(code: str, place: CodeRange, text: str) -> str:
    """The code with the text in that place."""
    lines = code.splitlines(keepends=True)
    first, last = place.start.line - 1, place.end.line - 1
    changed = lines[first][: place.start.column] + text + lines[last][place.end.column :]
    return "".join([*lines[:first], changed, *lines[last + 1 :]])


def changed_lines(before: Sequence[str], after: Sequence[str]) -> tuple[str, str]:
    """What stands between the first and the last line that differ by more than blanks, in both."""
    one, other = ([line.strip() for line in lines] for lines in (before, after))

    def alike(one: Sequence[str], other: Sequence[str]) -> int:
        """How many lines are the same at the start."""
        return len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False))))

    first = alike(one, other)
    one, other = one[first:], other[first:]
    last = alike(one[::-1], other[::-1])
    return "\n".join(one[: len(one) - last]), "\n".join(other[: len(other) - last])


# --- which test reaches what --------------------------------------------------------------------


@dataclass(frozen=True)
class CoverageMap:
    """What one undisturbed run of the tests showed."""

    cpu_seconds: dict[str, float]  # of processor time, of each test that passes
    tests_by_line: dict[str, dict[int, list[str]]]  # file → line → tests, "" for the import
    imported_libraries: list[str]  # imported modules that are not the project's

    def covering_tests(self, mutant: Mutant) -> set[str]:
        """The tests that run a line of its statement; "" among them where it runs on import."""
        first, last = mutant.statement_lines
        lines = self.tests_by_line.get(mutant.file, {})
        return {test for line, some in lines.items() if first <= line <= last for test in some}

    def tests_for(self, mutant: Mutant) -> list[str]:
        """Those that may notice it: all of the file's where its line runs on import.

        Those of the file's own name come first, the quickest of them, and they take no others' time.
        """
        near = self.covering_tests(mutant)
        if "" in near:
            near = {test for tests in self.tests_by_line[mutant.file].values() for test in tests}
        own = f"test_{Path(mutant.file).stem}.py::"
        ready = sorted(
            near & self.cpu_seconds.keys(), key=lambda test: (own not in test, self.cpu_seconds[test])
        )
        met, spent = [], {True: 0.0, False: 0.0}
        for test in ready:
            spent[own in test] += self.cpu_seconds[test]
            if spent[own in test] <= TEST_TIME_BUDGET:
                met.append(test)
        return met


class CoveragePlugin:
    """A pytest plugin: which lines each test runs, and for how long."""

    def __init__(self, files: Sequence[str]) -> None:
        self.files = files
        self.coverage = coverage.Coverage(data_file=None, config_file=False, include=list(files))
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Time the test and its fixtures, under its name."""
        self.coverage.switch_context(item.nodeid)
        start = time.process_time()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.process_time() - start
            self.coverage.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A test that does not pass undisturbed notices nothing."""
        if report.outcome != "passed":
            self.failed.add(report.nodeid)

    def result(self) -> CoverageMap:
        """The outcome."""
        data = self.coverage.get_data()
        lines = {file: data.contexts_by_lineno(str(Path(file).resolve())) for file in self.files}
        seconds = {t: s for t, s in self.seconds.items() if t not in self.failed}
        ours = {path.name for path in Path.cwd().iterdir()}
        names = [name for name in sys.modules if name.split(".")[0] not in ours | {"__main__"}]
        return CoverageMap(seconds, lines, names)


def run_tests(tests: Sequence[str], *plugins: object) -> int:
    """Run pytest in this process: 0 where all pass."""
    options = [word for name in PYTEST_PLUGINS for word in ("-p", name)]
    return int(
        pytest.main(
            ["-q", "-x", "-m", MARKS, "--timeout=0", "--hypothesis-seed=0", *options, *tests], [*plugins]
        )
    )


def measure_coverage(tests: Sequence[str], files: Sequence[str]) -> CoverageMap:
    """Run every test once, in a child, and see which lines it reaches."""
    with tempfile.NamedTemporaryFile("r", encoding="utf-8") as answer:
        child = os.fork()
        if child == 0:
            watch = CoveragePlugin(files)
            watch.coverage.start()
            code = run_tests(tests, watch)
            watch.coverage.stop()
            Path(answer.name).write_text(json.dumps(asdict(watch.result())), encoding="utf-8")
            os._exit(code)
        _, status = os.waitpid(child, 0)
        if status:
            raise SystemExit("the tests do not pass without any mutant: nothing can be said")
        document = json.load(answer)
    reached = document["tests_by_line"].items()
    document["tests_by_line"] = {file: {int(k): v for k, v in lines.items()} for file, lines in reached}
    return CoverageMap(**document)


# --- trial --------------------------------------------------------------------------------------


class MutatedModuleImporter(MetaPathFinder, Loader):
    """Imports one module from changed code."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant
        self.name = mutant.file.removesuffix(".py").replace("/", ".")

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        """Ours, or None."""
        file = str(Path(self.mutant.file).resolve())
        return spec_from_file_location(fullname, file, loader=self) if fullname == self.name else None

    def exec_module(self, module: ModuleType) -> None:
        """Run the changed code as the module."""
        exec(compile(self.mutant.code, str(Path(self.mutant.file).resolve()), "exec"), module.__dict__)


class TimeLimitPlugin:
    """A pytest plugin that ends the process where a test fails, or takes much longer than undisturbed.

    The exit code is the number of the test that fails, `MANY` for all beyond.
    """

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds, self.tests_started = seconds, 0
        self.set_timers(20.0)  # for imports

    def set_timers(self, seconds: float) -> None:
        """So much processor time from now, or twenty times that on the clock."""
        signal.setitimer(signal.ITIMER_PROF, seconds)
        signal.setitimer(signal.ITIMER_REAL, 20 * seconds)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A test begins."""
        self.set_timers(3 + 5 * self.seconds[nodeid])
        self.tests_started += 1

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """A test, or what prepares or follows it, has ended."""
        if report.failed:
            os._exit(min(self.tests_started, EXIT_LATE_TEST))


def restrict_child_process() -> None:
    """In a child: less memory, and nobody hears it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)


def start_trial(mutant: Mutant, tests: Sequence[str], seconds: dict[str, float]) -> int:
    """Fork a child that runs the tests on the mutant; its process id."""
    child = os.fork()
    if child:
        return child
    restrict_child_process()
    sys.meta_path.insert(0, MutatedModuleImporter(mutant))
    code = 1
    try:
        code = run_tests(tests, TimeLimitPlugin(seconds))
    finally:
        os._exit(code)


def swap_code(old: CodeType, new: CodeType, live: LiveFunctions) -> bool:
    """Give the functions whose code differs the new one; False where that is not all of the difference."""
    inner = [[c for c in code.co_consts if isinstance(c, CodeType)] for code in (old, new)]
    if len(inner[0]) != len(inner[1]):
        return False
    if old.co_flags & inspect.CO_OPTIMIZED:  # a function's
        if old == new:
            return True
        here = live.get((old.co_qualname, old.co_firstlineno), [])
        functions = [f for f in here if own_code(f.__code__) == own_code(old)]  # not two lambdas of a line
        if old.co_freevars != new.co_freevars or not (functions or "<locals>" in old.co_qualname):
            return False
        for function in functions:
            function.__code__ = new
    elif own_code(old) != own_code(new):  # what runs on import: a module's or a class's own
        return False
    return all(swap_code(one, other, live) for one, other in zip(*inner, strict=True))


def own_code(code: CodeType) -> tuple[object, ...]:
    """What a code object does itself, whatever the functions in it do."""
    constants = [repr(c) for c in code.co_consts if not isinstance(c, CodeType)]
    return code.co_code, code.co_names, code.co_varnames, constants


class KillHistory:
    """How often each test noticed a mistake in a file, for the next mutant to meet the likeliest first."""

    def __init__(self, coverage_map: CoverageMap) -> None:
        self.reach = coverage_map
        self.tried: Counter[tuple[str, str]] = Counter()
        self.noticed: Counter[tuple[str, str]] = Counter()

    def ordered_tests(self, mutant: Mutant) -> list[str]:
        """The tests of a mutant, by the time they take for each mistake noticed."""

        def price(test: str) -> float:
            at = mutant.file, test
            return self.reach.cpu_seconds[test] * (self.tried[at] + 2) / (self.noticed[at] + 1)

        return sorted(self.reach.tests_for(mutant), key=price)

    def record_result(self, mutant: Mutant, tests: Sequence[str], ended: int) -> None:
        """What a child's exit code says of the tests it was to run."""
        if ended >= 0 and ended != EXIT_NOT_TRIED:
            last = ended or len(tests)
            self.tried.update((mutant.file, test) for test in tests[:last])
            self.noticed.update((mutant.file, test) for test in tests[last - 1 : last] if ended)


class InPlaceTrials:
    """A pytest plugin that tries mutants instead of running the tests, each in a child of this process.

    The tests are collected and the project imported already: a child changes the code of functions in
    place.  What else a mutant changes (constants, defaults, a class) is not tried here: `UNTRIED`.
    """

    def __init__(
        self, mutants: Sequence[Mutant], coverage_map: CoverageMap, jobs: int, answers: IO[str]
    ) -> None:
        self.found, self.reach, self.jobs, self.answers = mutants, coverage_map, jobs, answers

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Try each mutant; a line of its number and the child's exit code for each."""
        items = {item.nodeid: item for item in session.items}
        live: dict[str, LiveFunctions] = {}
        for thing in gc.get_objects():
            if isinstance(thing, FunctionType):
                code = thing.__code__
                place = live.setdefault(code.co_filename, {})
                place.setdefault((code.co_qualname, code.co_firstlineno), []).append(thing)
        gc.collect()
        gc.freeze()
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):  # a child has timers of its own
            signal.setitimer(timer, 0)
        experience = KillHistory(self.reach)
        running: dict[int, tuple[int, list[str]]] = {}
        waiting = list(range(len(self.found)))[::-1]
        while waiting or running:
            while waiting and len(running) < self.jobs:
                number = waiting.pop()
                tests = experience.ordered_tests(self.found[number])
                child = os.fork()
                if not child:
                    self.start_trial(self.found[number], [items[test] for test in tests], live)
                running[child] = number, tests
            child, status = os.wait()
            number, tests = running.pop(child)
            ended = os.waitstatus_to_exitcode(status)
            experience.record_result(self.found[number], tests, ended)
            print(number, ended, file=self.answers, flush=True)
        return True

    def start_trial(
        self, mutant: Mutant, tests: Sequence[pytest.Item], live: dict[str, LiveFunctions]
    ) -> NoReturn:
        """In the child: the tests on the mutant."""
        restrict_child_process()
        path = str(Path(mutant.file).resolve())
        old, new = (compile(code, path, "exec") for code in (Path(path).read_text("utf-8"), mutant.code))
        code = 1
        try:
            if not swap_code(old, new, live.get(path, {})):
                os._exit(EXIT_NOT_TRIED)
            for test, following in itertools.zip_longest(tests, tests[1:]):
                test.config.hook.pytest_runtest_protocol(item=test, nextitem=following)
            code = 0
        finally:
            os._exit(code)


def run_in_place_trials(
    mutants: Sequence[Mutant], tests: Sequence[str], coverage_map: CoverageMap, jobs: int
) -> Iterator[tuple[int, int]]:
    """Numbers of mutants and exit codes, `UNTRIED` for those that are still to be tried otherwise."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        code = 1
        try:
            with os.fdopen(writer, "w") as answers:
                plugins = (
                    InPlaceTrials(mutants, coverage_map, jobs, answers),
                    TimeLimitPlugin(coverage_map.cpu_seconds),
                )
                code = run_tests([*tests, "--capture=no"], *plugins)
        finally:
            os._exit(code)
    os.close(writer)
    with os.fdopen(reader) as answers:
        for line in answers:
            number, code = map(int, line.split())
            yield number, code
    if os.waitpid(child, 0)[1]:
        raise SystemExit("the tests cannot be collected: nothing can be said")


def run_trials(
    mutants: Sequence[Mutant], tests: Sequence[str], coverage_map: CoverageMap, jobs: int
) -> Iterator[tuple[Mutant, str]]:
    """Each mutant with what became of it: noticed, endless, survived or unreached."""
    reached = [mutant for mutant in mutants if coverage_map.tests_for(mutant)]
    yield from ((mutant, "unreached") for mutant in mutants if not coverage_map.tests_for(mutant))
    waiting = []
    for number, ended in run_in_place_trials(reached, tests, coverage_map, jobs):
        mutant = reached[number]
        # what has run on import or collection made things before the mutant was there
        if ended == EXIT_NOT_TRIED or (ended == 0 and "" in coverage_map.covering_tests(mutant)):
            waiting.append(mutant)
        else:
            yield mutant, outcome_of_exit_code(ended)
    yield from run_trials_from_import(waiting[::-1], coverage_map, jobs)


def run_trials_from_import(
    waiting: list[Mutant], coverage_map: CoverageMap, jobs: int
) -> Iterator[tuple[Mutant, str]]:
    """The same, each from the import on."""
    running: dict[int, Mutant] = {}
    while waiting or running:
        while waiting and len(running) < jobs:
            mutant = waiting.pop()
            running[start_trial(mutant, coverage_map.tests_for(mutant), coverage_map.cpu_seconds)] = mutant
        child, status = os.wait()
        yield running.pop(child), outcome_of_exit_code(os.waitstatus_to_exitcode(status))


def outcome_of_exit_code(ended: int) -> str:
    """What a child's exit code says of its mutant."""
    endless = ended in (-signal.SIGPROF, -signal.SIGALRM)
    return "survived" if ended == 0 else "endless" if endless else "noticed"


# --- the command --------------------------------------------------------------------------------


def target_files(target: str) -> list[str]:
    """The files of a target, or of a path; none where nothing has the name."""
    return sorted(str(path) for pattern in TARGETS.get(target, [target]) for path in Path().glob(pattern))


def results_path(target: str, options: argparse.Namespace) -> Path:
    """The JSON file of a target's mutants and of what became of them."""
    return Path(options.out) / f"{target.replace('/', '-')}.json"


def target_tests(files: Sequence[str]) -> list[str]:
    """The test files that must notice the mutants of these files."""
    groups = [name for name in TARGETS if name in TEST_FILES and {*files} <= {*target_files(name)}]
    tests = TEST_FILES[groups[0] if groups else files[0].split("/")[0]]
    return sorted({str(path) for pattern in tests for path in Path().glob(pattern)})


def run_target(target: str, options: argparse.Namespace) -> int:
    """In the copy: find the mutants of a target, try them, judge."""
    files = target_files(target)
    found = find_mutants(files, options.sample, options.seed)
    table = results_path(target, options)
    if options.again:
        last = json.loads(table.read_text(encoding="utf-8"))
        left = {
            (m["file"], m["function"], m["change"], m["occurrence"])
            for m in last
            if m["became"] in ("survived", "unreached")
        }
        found = [mutant for mutant in found if mutant.key in left]
    start = time.monotonic()
    tests = target_tests(files)
    reach = measure_coverage(tests, files)
    print(f"{len(reach.cpu_seconds)} tests in {time.monotonic() - start:.0f} s", flush=True)
    for name in reach.imported_libraries:
        try:
            importlib.import_module(name)
        except Exception:  # a name that cannot be imported on its own is imported by the child
            continue
    gc.collect()
    gc.freeze()  # else every child would go through all of it, and copy it
    sound = {mutant.file: Path(mutant.file).read_text(encoding="utf-8") for mutant in found}
    controls = [Mutant(file, 0, (0, 10**6), "", "", code, "", "", 0) for file, code in sound.items()]
    if any(
        what not in ("survived", "unreached") for _, what in run_trials(controls, tests, reach, options.jobs)
    ):
        raise SystemExit("the tests do not pass in a child without any mutant: nothing can be said")
    became = []
    for mutant, what in run_trials(found, tests, reach, options.jobs):
        became.append((mutant, what))
        if what in ("survived", "unreached"):
            print(f"{what}: {mutant.file}:{mutant.line}\n  - {mutant.was}\n  + {mutant.now}", flush=True)
        if len(became) % 50 == 0:
            print(f"{len(became)} of {len(found)}, {time.monotonic() - start:.0f} s", flush=True)
    table.parent.mkdir(parents=True, exist_ok=True)
    records = [{**asdict(mutant), "code": None, "became": what} for mutant, what in became]
    table.write_text(json.dumps(records, indent=1, ensure_ascii=False), encoding="utf-8")
    return print_report(became, files, MIN_MUTATION_SCORE if not options.again else 0.0)


def print_report(outcomes: Sequence[tuple[Mutant, str]], files: Sequence[str], least: float) -> int:
    """Print the figures; 1 where something is amiss."""
    kinds = Counter(what for _, what in outcomes)
    rate = (kinds["noticed"] + kinds["endless"]) / max(len(outcomes), 1)
    known = load_survivors()
    left = [mutant for mutant, what in outcomes if what in ("survived", "unreached")]
    new = [mutant for mutant in left if mutant.key not in known]
    alive = {mutant.key for mutant in left}  # the same line may stand in several places
    stale = [mutant for mutant, _ in outcomes if mutant.key in known and mutant.key not in alive]
    print(
        f"{len(outcomes)} mutants of {', '.join(files)}: {100 * rate:.1f} % noticed, {kinds['endless']} of "
        f"them by never ending; {len(left)} survive, {len(left) - len(new)} of them listed in "
        f"{SURVIVORS_FILE.name}"
    )
    for heading, mutants in (("not listed", new), ("listed, but noticed", stale)):
        for mutant in mutants:
            where = f"{mutant.file}:{mutant.line} {mutant.function}: {mutant.change} ({mutant.occurrence})"
            print(f"{heading}: {where}\n  - {mutant.was}\n  + {mutant.now}")
    return int(rate < least or bool(new) or bool(stale))


def copy_checkout(target: Path) -> None:
    """The checkout's files, without what git ignores."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    for name in filter(None, listed.split("\0")):
        if Path(name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(name, target / name)


def main() -> int:
    """Copy the checkout and go on there."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.mutation", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("target", nargs="+", help=f"{', '.join(TARGETS)}, or files")
    parser.add_argument("--sample", type=int, help="so many mutants, drawn at random; default all")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--jobs", type=int, default=1, help="children at a time")
    parser.add_argument(
        "--out", default="reports/out/mutation", help="folder of the outcome, a JSON file per target"
    )
    parser.add_argument("--again", action="store_true", help="only those that survived last time")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.inside:
        return max([run_target(target, options) for target in options.target])
    for target in options.target:
        if not target_files(target):
            parser.error(f"{target}: no such file; valid are {', '.join(TARGETS)} and paths of Python files")
        if options.again and not results_path(target, options).exists():
            parser.error(f"{target}: not tried before, there is no {results_path(target, options)}")
    with tempfile.TemporaryDirectory(prefix="plumbline-mutation-") as folder:
        copy_checkout(Path(folder))
        command = [sys.executable, "-m", "tools.mutation.mutation", *sys.argv[1:], "--inside"]
        command += ["--out", str(Path(options.out).resolve())]
        plain = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONDONTWRITEBYTECODE": "", "OMP_NUM_THREADS": "1"}
        return subprocess.run(command, cwd=folder, env=os.environ | plain, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
