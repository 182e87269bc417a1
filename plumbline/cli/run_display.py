"""What a run shows while it goes on: verdicts as they come, and how far it is."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.live import Live

from plumbline.cli.terminal_output import ProgressDisplay, make_console
from plumbline.cli.verdict_matrix import VerdictMatrix
from plumbline.engines.adapter import EngineInfo
from plumbline.execution.plan import ProgressCallback, RunObserver
from plumbline.judging.rows import Row

REFRESH_INTERVAL = 0.25  # s between two pictures of the table on a terminal


class RunDisplay(ProgressDisplay, RunObserver):
    """The matrix that fills in, above the progress bar; elsewhere than on a terminal a line per scenario.

    Attributes:
        rows: those of the scenarios whose tasks have all finished, by scenario.

    """

    def __init__(self, file: Any) -> None:
        super().__init__(file)
        self.rows: dict[str, Sequence[Row]] = {}
        self._matrix = VerdictMatrix({})  # with the rows of unfinished scenarios too
        self._refreshed = 0.0  # monotonic time of the last picture
        self._live = Live(
            console=self.bar.console, transient=True, auto_refresh=False, get_renderable=self._picture
        )

    def __enter__(self) -> ProgressCallback:
        """Start the picture; the value is the function to call after each task."""
        if self.file.isatty():
            self._live.start()
        self.task = self.bar.add_task("running", total=None)
        return self.update

    def __exit__(self, *_: object) -> None:
        """Remove the picture."""
        self._live.stop()

    def on_start(self, engines: Mapping[str, EngineInfo]) -> None:
        """Take the descriptions of the engines, which are the columns.

        Args:
            engines: description by name.

        """
        self._matrix = VerdictMatrix(engines)

    def on_rows(self, scenario: str, rows: Sequence[Row], is_complete: bool) -> None:
        """Take rows of a scenario.

        Args:
            rows: new rows; all rows of the scenario where it is complete.

        """
        if not is_complete:
            self._matrix.add_rows(scenario, rows)
            return
        self.rows[scenario] = rows
        self._matrix.replace_rows(scenario, rows)
        if not self.file.isatty():
            make_console(self.file).print(self._matrix.line(scenario), soft_wrap=True)

    def update(self, done: int, total: int, task_name: str) -> None:
        """Show how far the run is.

        Args:
            total: tasks that are known so far.
            task_name: the task that finished last.

        """
        super().update(done, total, task_name)
        if self._live.is_started and time.monotonic() - self._refreshed > REFRESH_INTERVAL:
            self._live.refresh()
            self._refreshed = time.monotonic()

    def _picture(self) -> Group:
        lines = max(self.bar.console.height - 4, 1)
        return Group(self._matrix.table(lines), self.bar.get_renderable())
