"""What an importer column offers to the comparison: its reading of a file, and quantities at given states.

Both functions of an importer run in a worker process: importers crash.  `Importer.evaluate` receives states
in the canonical coordinates of the reading that `Importer.read` returned; a reading may have other joints
than the file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from plumbline.importers.neutral_model import CanonicalState, ModelQuantities, NeutralModel

Format = Literal["urdf", "mjcf"]
Base = Literal["fixed", "free"]


@dataclass(frozen=True)
class ModelFile:
    """A file to load, and how.

    ``path`` is the file that an importer opens: the user's own, or a copy without visual and collision
    geometry.  Unnamed bodies and joints of an MJCF file have been given names in such a copy, because
    importers make up different ones.
    """

    path: str  # absolute
    format: Format
    base: Base = "fixed"  # of a URDF: whether the root link is fixed to the world; MJCF says it itself
    root: str = ""  # folder to which package:// and relative mesh paths resolve, absolute


@dataclass(frozen=True, eq=False)
class Reading:
    """What an importer made of a file."""

    version: str  # of the engine
    model: NeutralModel | None = None  # None: refused
    refusal: str = ""  # the importer's words


class Importer(ABC):
    """One engine's importer of model files."""

    name: ClassVar[str]  # as typed on the command line: mujoco, pinocchio, exudyn, drake, dart, pybullet
    title: ClassVar[str]
    package: ClassVar[str]  # distribution whose version is reported
    formats: ClassVar[tuple[Format, ...]]
    # Quantities that the engine does not compute (a field of `ModelQuantities`), and why, in a sentence.
    unsupported: ClassVar[dict[str, str]] = {}
    supported_versions: ClassVar[str] = ""  # PEP 440 range of versions that the column works with
    # Requirements of environments with another version: (range of versions, additional requirement).
    extra_requirements: ClassVar[tuple[tuple[str, str], ...]] = ()
    environment: ClassVar[str] = ""  # folder that `make importers` installs it into; empty: the main one

    @abstractmethod
    def version(self) -> str:
        """Return the version of the engine that is loaded.

        Returns:
            A PEP 440 version.

        """

    @abstractmethod
    def read(self, file: ModelFile) -> Reading:
        """Load a file and describe what the engine made of it.

        Returns:
            The engine's model object in neutral terms, lumped links left out; or its refusal.

        """

    @abstractmethod
    def evaluate(self, file: ModelFile, states: Sequence[CanonicalState]) -> list[ModelQuantities]:
        """Compute the quantities that are compared.

        Args:
            file: a file that `read` accepts.
            states: canonical states of the model that `read` returned.

        Returns:
            One record per state, in canonical velocities of that model.

        """
