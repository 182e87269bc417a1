"""Exit codes of the command line: the one table that the help shows and the pages repeat."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """How a command ended; of several that apply, a run returns the harness's, then an engine's, then 1."""

    SUCCESS = 0
    DISAGREEMENT = 1
    BAD_USAGE = 2
    ENGINE_FAILED = 3
    MACHINE_FAILED = 4
    HARNESS_FAILED = 5
    INTERRUPTED = 130


EXIT_CODE_MEANINGS = {
    ExitCode.SUCCESS: "everything agrees, or differs as recorded in known_issues.yaml; rows of your own "
    "scenarios may be unresolved",
    ExitCode.DISAGREEMENT: "a disagreement, a gap that is neither declared nor recorded, a stale record, a "
    "certificate that proves nothing, or nothing was compared",
    ExitCode.BAD_USAGE: "bad usage or a bad file",
    ExitCode.ENGINE_FAILED: "an engine failed: raised, crashed, hung, or is missing though it was named",
    ExitCode.MACHINE_FAILED: "the machine failed: disk full, input/output error, cluster lost",
    ExitCode.HARNESS_FAILED: "the harness failed: the truth is in doubt, or an internal error",
    ExitCode.INTERRUPTED: "interrupted: the same command resumes; finished cells are kept where the result "
    "cache can be used",
}
