"""Headlines and progress of the demo: bars in a terminal, a line now and then elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TimeElapsedColumn
from rich.text import Text

from armlink.commands.plain_console import PlainColumn
from armlink.content.printable_text import printable_text

Report = Callable[[float, float, float | None, str], None]
"""Called with (done, total, seconds left, what is being done)."""


class Narrator:
    """Lines with the time since the start, and progress, on a console."""

    def __init__(self, console: Console, results: Console) -> None:
        """Progress on `console`, tables and findings on `results`."""
        self.console, self.results = console, results
        self._began = time.monotonic()

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self._began

    def say(self, text: str, style: str = "") -> None:
        self.console.print(self._stamped(text, style), soft_wrap=True)

    def find(self, text: str) -> None:
        """The same among the results."""
        self.results.print(self._stamped(text, ""), soft_wrap=True)

    def _stamped(self, text: str, style: str) -> Text:
        return Text.assemble((f"{self.elapsed:5.0f} s", "dim"), "  ", (printable_text(text), style))

    @contextmanager
    def stage(self, headline: str) -> Iterator[Report]:
        """A stage of the work; the work calls the yielded function as it goes on."""
        self.say(headline, style="bold")
        columns = (PlainColumn("        "), BarColumn(), PlainColumn("{task.description}"), TimeElapsedColumn())
        if not self.console.is_terminal:
            yield self._lines()
            return
        with Progress(*columns, console=self.console, transient=True) as progress:
            task = progress.add_task("")
            yield lambda done, total, left, text: progress.update(
                task, completed=done, total=total, description=_with_time(text, left)
            )

    def _lines(self, period_s: float = 5.0) -> Report:
        said = time.monotonic()

        def report(done: float, total: float, left: float | None, text: str) -> None:
            nonlocal said
            if time.monotonic() - said >= period_s:
                said = time.monotonic()
                self.say(f"   {done / max(total, 1e-9):4.0%}  {_with_time(text, left)}")

        return report


def _with_time(text: str, left: float | None) -> str:
    return text if left is None else f"{text}, {left:.0f} s left"
