"""Says what the demo is doing: progress bars in a terminal, a line now and then elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TimeElapsedColumn
from rich.text import Text

from armlink.commands.plain_console import PlainColumn
from armlink.content.printable_text import printable_text

QUIET_SECONDS = 5.0
"""Without a terminal, a line at most this often [s]."""

Report = Callable[[float, float, float | None, str], None]
"""Called with (done, total, seconds left, what is being done)."""


class Narrator:
    """Headlines and progress on a console."""

    def __init__(self, console: Console, results: Console) -> None:
        """Progress on `console`, tables and findings on `results`."""
        self._console, self._results = console, results
        self._began = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Wall time since the start [s]."""
        return time.monotonic() - self._began

    def say(self, text: str, style: str = "") -> None:
        """One line, with the time since the start."""
        self._console.print(self._stamped(text, style), soft_wrap=True)

    def find(self, text: str) -> None:
        """The same among the results."""
        self._results.print(self._stamped(text, ""), soft_wrap=True)

    def _stamped(self, text: str, style: str) -> Text:
        return Text.assemble((f"{self.elapsed:5.0f} s", "dim"), "  ", (printable_text(text), style))

    def show(self, table: object) -> None:
        """A rich table."""
        self._results.print(table)

    @contextmanager
    def stage(self, headline: str) -> Iterator[Report]:
        """A stage of the work; what it yields is told how far it is."""
        self.say(headline, style="bold")
        if self._console.is_terminal:
            with self._bar() as report:
                yield report
        else:
            yield self._lines()

    @contextmanager
    def _bar(self) -> Iterator[Report]:
        columns = (PlainColumn("        "), BarColumn(), PlainColumn("{task.description}"), TimeElapsedColumn())
        with Progress(*columns, console=self._console, transient=True) as progress:
            task = progress.add_task("")

            def report(done: float, total: float, left: float | None, text: str) -> None:
                progress.update(task, completed=done, total=total, description=_line(text, left))

            yield report

    def _lines(self) -> Report:
        said = time.monotonic()

        def report(done: float, total: float, left: float | None, text: str) -> None:
            nonlocal said
            if time.monotonic() - said >= QUIET_SECONDS:
                said = time.monotonic()
                self.say(f"   {done / max(total, 1e-9):4.0%}  {_line(text, left)}")

        return report


def _line(text: str, left: float | None) -> str:
    return text if left is None else f"{text}, {left:.0f} s left"
