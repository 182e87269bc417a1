"""From the file that a user names to the file that importers open, and the neutral model of it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from os.path import isfile
from pathlib import Path
from tempfile import mkdtemp
from typing import Literal
from urllib.parse import unquote

from plumbline.importers import mjcf
from plumbline.importers.importer import Base, Format, ModelFile, Reading
from plumbline.importers.mjcf_rewriting import rewritings
from plumbline.importers.neutral_model import Feature, NeutralModel, Source, extreme_numbers, zero_directions
from plumbline.importers.urdf import read_urdf
from plumbline.importers.xml_tree import Element, ModelFileError, read_xml, write_xml, write_xml_in_place
from plumbline.processes.user_cache import naming_file
from plumbline.scenario.line_and_column_errors import shorten

BaseChoice = Literal["fixed", "free", "auto"]
STRIP_HINT = "--strip-geometry leaves meshes out"
MJCF_READER = "mujoco"  # whose compiled model is the neutral reading of MJCF
_LINE = re.compile(r"\bline (\d{1,9})\b")
_ELEMENT = re.compile(r"\bElement '([^']*)'")  # as MuJoCo names elements; other importers name lines at most
_ELEMENT_NAME = re.compile(r"\bElement name '([^']*)'")
_ROOT_TAGS: dict[str, Format] = {"robot": "urdf", "mujoco": "mjcf"}


@dataclass(frozen=True, eq=False)
class PreparedFile:
    """A file that has been checked and is ready for importers."""

    shown: str  # as the user typed it
    tree: Element  # of the file that importers open; sources are those of the user's files
    file: ModelFile
    urdf_model: NeutralModel | None  # the own reading; None for MJCF, which MuJoCo compiles in a worker
    lines: Mapping[int, Sequence[Element]]  # that begin in each line of the file that importers open
    not_compared: tuple[Feature, ...] = ()  # of an MJCF, its geometry included

    def neutral_model(self, reading: Reading | None, failure: str = "") -> NeutralModel:
        """Return what the file says.

        Args:
            reading: MuJoCo's reading of an MJCF file; not used for a URDF.
            failure: why there is none, as "did not compile it within 20 s".

        Returns:
            The neutral model with sources.

        Raises:
            ModelFileError: MuJoCo, which defines MJCF, refuses the file or fails, or numbers are so large
                or small that no engine can compute with them.

        """
        model = self.urdf_model
        if model is None and (reading is None or reading.model is None):
            place = self.place_of(reading.refusal) if reading else Source(self.shown, 1)
            words = f"refuses it: {self.in_users_words(reading.refusal)}" if reading else failure
            message = f"MuJoCo, which defines MJCF, {shorten(words, 400)}"
            raise ModelFileError([place.problem(message)])
        if model is None:
            assert reading is not None and reading.model is not None
            model = replace(mjcf.with_sources(reading.model, self.tree), not_compared=self.not_compared)
        problems = [
            place.problem(f"{what} is {value:g}", valid)
            for what, value, valid, place in [*extreme_numbers(model)] or [*zero_directions(model)]
        ]
        if problems:
            raise ModelFileError(problems)
        return model

    def place_of(self, words: str) -> Source:
        """Find the place in the user's files that an importer's message is about.

        Args:
            words: of the importer, about the file that it opened.

        Returns:
            The place of the last line that the message names, else of the element, else of the root.

        """
        lines, names = _LINE.findall(words), _ELEMENT_NAME.findall(words)
        found = self._elements(int(lines[-1]), words) if lines else []
        if not found and names:
            found = [e for e in self.tree.walk() if e.attributes.get("name") == names[-1]][-1:]
        return (found or [self.tree])[0].source

    def in_users_words(self, words: str) -> str:
        """Write an importer's message on one line, with the user's files and lines.

        Args:
            words: of the importer, about the file that it opened.

        """

        def line_of_user(match: re.Match[str]) -> str:
            found = self._elements(int(match[1]), words)
            place = found[0].source if found else Source(self.shown, int(match[1]))
            return f"line {place.line}" + (f" of {place.file}" if place.file != self.shown else "")

        return _LINE.sub(line_of_user, " ".join(words.replace(self.file.path, self.shown).split()))

    def _elements(self, line: int, words: str) -> list[Element]:
        """The elements that begin in a line of the opened file, those first whose tag the words name."""
        tags = _ELEMENT.findall(words)
        return sorted(self.lines.get(line, ()), key=lambda element: element.tag not in tags)

    def write_rewritings(self, folder: Path) -> dict[str, ModelFile]:
        """Write equivalent rewritings of an MJCF file, in a folder of their own below a given one.

        Returns:
            Files for importers, by what was done to them.

        """
        tree = deepcopy(self.tree)
        mjcf.make_paths_absolute(tree, Path(self.shown).parent.resolve())
        found = {}
        own_folder = Path(mkdtemp(dir=folder))  # a copy of the user's file may have any name in the other
        for count, (name, rewritten) in enumerate(rewritings(tree).items()):
            path = own_folder / f"{count}.xml"
            with naming_file(path):
                path.write_text(write_xml(rewritten), encoding="utf-8")
            found[name] = replace(self.file, path=str(path))
        return found


def prepare_file(
    shown: str, scratch: Path, root: Path | None = None, base: BaseChoice = "auto", strip: bool = False
) -> PreparedFile:
    """Check a model file and make it ready for importers.

    Args:
        scratch: a folder for a copy with all names, or without geometry.
        root: folder outside of which no file is read; None: the nearest folder above the file that has a
            package.xml, else the file's own.
        base: of a URDF, whether the root link is fixed; "auto" is fixed.

    Raises:
        ModelFileError: the file cannot be used; every mistake that was found has its line.

    """
    path = Path(shown)
    tree = read_xml(path, shown)
    kind = _format_of(tree, shown)
    folder = (root or package_folder(path)).resolve()
    if mjcf.resolve_inside(path, folder) is None:
        raise ModelFileError([Source(shown, 0).problem(f"is outside the root folder {folder}")])
    chosen: Base = "fixed" if base == "auto" else base
    if kind == "mjcf" and base != "auto":
        hint = "leave --base out, or add or remove the <freejoint> in the file"
        message = "an MJCF file says itself whether its base moves"
        raise ModelFileError([Source(shown, 1).problem(message, hint=hint)])
    is_copied, features = strip, tuple[Feature, ...]()
    if kind == "mjcf":
        count = sum(1 for element in tree.walk() if element.tag == "include")
        mjcf.expand_includes(tree, folder, shown)
        is_copied |= mjcf.name_elements(tree) or count > 0
        features = mjcf.features_not_compared(tree)
        if strip:
            mjcf.strip_geometry(tree)
    elif strip:
        for link in tree.find_all("link"):
            link.children = [c for c in link.children if c.tag not in ("visual", "collision")]
    model = read_urdf(tree, chosen) if kind == "urdf" else None
    leave_out = "the mass of a body without <inertial> is made of it" if strip else STRIP_HINT
    _check_references(tree, kind, path, folder, f"{leave_out}; --root names another folder")
    opened, lines = path.resolve(), dict[int, list[Element]]()
    if is_copied:
        if kind == "mjcf":
            mjcf.make_paths_absolute(tree, path.parent.resolve())
        opened = scratch / path.name
        text, lines = write_xml_in_place(tree)
        with naming_file(opened):
            opened.write_text(text, encoding="utf-8")
    else:
        for element in tree.walk():
            lines.setdefault(element.source.line, []).append(element)
    file = ModelFile(str(opened), kind, chosen, str(folder))
    return PreparedFile(shown, tree, file, model, lines, features)


def package_folder(path: Path) -> Path:
    """Find the package that a file is in.

    Returns:
        The nearest folder above it that has a package.xml, else its own folder.

    """
    folder = path.resolve().parent
    return next((p for p in (folder, *folder.parents) if isfile(p / "package.xml")), folder)


def _format_of(tree: Element, shown: str) -> Format:
    """Return the format; other formats get a sentence that says what to do."""
    names = [n for element in tree.walk() for n in (element.tag, *element.attributes)]
    if any(name.startswith(("xacro:", "xmlns:xacro")) and not name.startswith("xmlns") for name in names):
        hint = f"expand it first: xacro {shown} > robot.urdf"
        raise ModelFileError([tree.source.problem("is a xacro file", hint=hint)])
    if tree.tag in _ROOT_TAGS:
        return _ROOT_TAGS[tree.tag]
    message, hint = f"its root element is <{shorten(tree.tag)}>", ""
    if tree.tag in ("sdf", "world", "model"):
        message, hint = "is an SDF file", "convert it to URDF, or name the URDF that it was made from"
    elif tree.tag == "mujocoinclude":
        hint = "name the file that includes it"
    raise ModelFileError([tree.source.problem(message, "<robot> (URDF) or <mujoco> (MJCF)", hint)])


def _check_references(tree: Element, kind: Format, file: Path, root: Path, hint: str) -> None:
    """Refuse files that are missing, outside the root, or on the network, those of models of assets too."""
    checked, pending = {file.resolve()}, [(tree, kind, file)]
    while pending:
        tree, kind, file = pending.pop()
        for element, inside in _check_files(tree, kind, file.parent, root, hint):
            if element.tag != "model" or inside in checked:
                continue
            checked.add(inside)
            shown = str(Path(tree.source.file).parent / element.attributes["file"])
            model = read_xml(inside, shown)
            if (kind_of_model := _format_of(model, shown)) == "mjcf":
                mjcf.expand_includes(model, root, shown)
            pending.append((model, kind_of_model, inside))


def _check_files(
    tree: Element, kind: Format, folder: Path, root: Path, hint: str
) -> list[tuple[Element, Path]]:
    """Refuse files that one file names; return those that are there, with the elements that name them."""
    problems, good = [], []
    if kind == "mjcf":
        found = list(mjcf.asset_files(tree, folder))
    else:
        found = [
            (element, "filename", Path(element.attributes["filename"]))
            for link in tree.find_all("link")
            for element in link.walk()
            if element.tag in ("mesh", "texture") and "filename" in element.attributes
        ]
    for element, attribute, path in found:
        name = element.attributes[attribute]
        if kind == "urdf":
            scheme, _, rest = name.rpartition("://")
            if scheme not in ("", "package", "model", "file"):
                problems.append(element.problem(f"{shorten(repr(name))} is on the network", attribute))
                continue
            candidates = (
                _package_paths(unquote(rest), root)
                if scheme in ("package", "model")
                else [folder / (unquote(rest) if scheme else name)]
            )
        else:
            candidates = [path]
        inside = [target for c in candidates if (target := mjcf.resolve_inside(c, root)) is not None]
        there = [target for target in inside if isfile(target)]
        good += [(element, target) for target in there[:1]]
        if not inside:
            problems.append(element.problem(f"{shorten(repr(name))} is outside {root}", attribute, hint=hint))
        elif not there:
            message = f"there is no file {shorten(repr(name))} in {root}"
            problems.append(element.problem(message, attribute, hint=hint))
    if problems:
        raise ModelFileError(problems)
    return good


def _package_paths(rest: str, root: Path) -> list[Path]:
    """Where package://NAME/REST may be: in the root, which is the package or holds it."""
    inner = rest.partition("/")[2]
    return [root / rest, root / inner, *([root.parent / rest] if root.name == rest.partition("/")[0] else [])]
