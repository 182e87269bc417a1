"""The servers of further engines (`make engines`): what they cost, which can be built, and building them.

python -m tools.engine_servers            lists and builds
python -m tools.engine_servers --list     lists only: nothing is downloaded or built
python -m tools.engine_servers --options  prints the options that add those that are built to a night
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from plumbline.engines.registry import ENGINES

ROOT = Path(__file__).resolve().parents[1]
SERVERS, BUILT = ROOT / "servers", ROOT / ".engines"
IMPORTERS_PYTHON = ROOT / ".importers" / "bin" / "python"
SIMBODY_INCLUDE = Path("/usr/include/simbody")
JSON_INCLUDE = Path("/usr/include/nlohmann/json.hpp")


@dataclass(frozen=True)
class Server:
    """One server: what its engine is, and how it is had."""

    name: str
    engine: str
    licence: str  # SPDX, of the engine
    size: str  # of what is downloaded and built
    source: str  # where it comes from
    command: tuple[str | Path, ...]  # starts it
    missing: Callable[[], str]  # why it cannot be built here; empty where it can
    build: tuple[tuple[str | Path, ...], ...] = ()  # commands

    @property
    def is_built(self) -> bool:
        """Whether the command's files are there."""
        return all(part.exists() for part in self.command if isinstance(part, Path))

    @property
    def adapter(self) -> str:
        """The engine as `--adapter` takes it; its column is called after the server's file."""
        return "cmd:" + shlex.join(map(str, self.command))

    @property
    def options(self) -> list[str]:
        """The options that add the engine to a run, and what is recorded of it."""
        known = SERVERS / f"{self.name}_known_issues.yaml"
        return ["--adapter", self.adapter, *(["--known", str(known)] if known.exists() else [])]


def _needs(program: str, why: str) -> Callable[[], str]:
    return lambda: "" if shutil.which(program) else f"{program} is not installed; {why}"


def _needs_simbody() -> str:
    absent = [str(path) for path in (SIMBODY_INCLUDE, JSON_INCLUDE) if not path.exists()]
    packages = "`apt install libsimbody-dev nlohmann-json3-dev` installs it on Debian and Ubuntu"
    return _needs("g++", packages)() or (f"there is no {absent[0]}; {packages}" if absent else "")


_RAPIER = ("cargo", "build", "--release", "--manifest-path", SERVERS / "rapier" / "Cargo.toml",
           "--target-dir", BUILT / "rapier")  # fmt: skip
_MAKE = ("make", "-C", ROOT, ".importers/.done")
ENGINE_SERVERS = (
    Server("drake", "Drake", "BSD-3-Clause", "470 MB", "the package index",
           (IMPORTERS_PYTHON, SERVERS / "drake_server.py"), _needs("make", "it makes .importers"), (_MAKE,)),
    Server("dart", "DART", "BSD-2-Clause", "240 MB, with Drake's", "the package index",
           (IMPORTERS_PYTHON, SERVERS / "dart_server.py"), _needs("make", "it makes .importers"), (_MAKE,)),
    Server("rapier", "Rapier, double precision", "Apache-2.0", "30 MB, 300 MB while it is built", "crates",
           (BUILT / "rapier" / "release" / "rapier_server",),
           _needs("cargo", "https://rustup.rs has it"), (_RAPIER,)),
    Server("simbody", "Simbody", "Apache-2.0", "64 MB", "the system's packages",
           (BUILT / "simbody_server",), _needs_simbody,
           (("g++", "-std=c++17", "-O2", "-w", f"-I{SIMBODY_INCLUDE}", SERVERS / "simbody_server.cpp", "-o",
             BUILT / "simbody_server", "-lSimTKsimbody", "-lSimTKmath", "-lSimTKcommon"),)),
)  # fmt: skip


def build(server: Server) -> str:
    """Build a server, first with what is on this machine alone.

    Returns:
        Why it is not there afterwards; empty where it is.

    """
    if why := server.missing():
        return why
    BUILT.mkdir(exist_ok=True)
    offline = os.environ | {"CARGO_NET_OFFLINE": "true", "UV_OFFLINE": "1"}
    for command in server.build:
        for environment in (offline, dict(os.environ)):
            done = subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True)
            if done.returncode == 0:
                break
        else:
            return f"`{shlex.join(map(str, command[:2]))} …` failed: {done.stderr.strip()[-400:]}"
    return ""


def main() -> int:
    """List the servers, and build them unless asked not to."""
    parser = argparse.ArgumentParser(description="Servers of further engines.")
    parser.add_argument("names", nargs="*", help="of servers; default: all")
    parser.add_argument("--list", action="store_true", help="build nothing")
    parser.add_argument("--options", action="store_true", help="print the options of a night with them")
    options = parser.parse_args()
    chosen = [s for s in ENGINE_SERVERS if not options.names or s.name in options.names]
    if options.options:
        own = [word for s in chosen if s.is_built for word in s.options]
        print(shlex.join([word for name in ENGINES for word in ("--engine", name)] + own if own else []))
        return 0
    for s in chosen:
        state = "is built" if s.is_built else s.missing() or "can be built here"
        print(f"{s.name:8} {s.engine}, {s.licence}, {s.size} from {s.source}: {state}", flush=True)
    for s in [] if options.list else [s for s in chosen if not s.is_built]:
        print(f"{s.name:8} …", end=" ", flush=True)
        print(build(s) or "built", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
