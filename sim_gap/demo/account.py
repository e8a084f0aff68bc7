"""The demo's account of itself: lines in the terminal, `summary.json` (schema armlink.demo/1), and the page."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.text import Text

from armlink.commands.output import write_json
from armlink.commands.plain_console import PlainConsole, results
from armlink.content.printable_text import printable_text
from calib.commands.screen import SweepScreen, print_intervals
from calib.report.page import ReportSection as Section
from calib.report.page import bullets, paragraph, render
from calib.report.tables import ReportTable, interval_table
from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import plain_json

OPENED = "The fit saw only what came over the bus. The true values were opened only after everything was estimated."


class Account:
    def __init__(self, json_path: Path | None) -> None:
        self.summary: dict[str, Any] = {}
        self.sections: list[Section] = []
        self._findings, self.began = list[str](), time.monotonic()
        self._json, self._results, self._console = json_path, results(json_path), PlainConsole()

    def say(self, text: str, style: str = "", console: PlainConsole | None = None) -> None:
        line = Text.assemble((f"{time.monotonic() - self.began:5.0f} s", "dim"), "  ", (printable_text(text), style))
        (console or self._console).print(line)

    @contextmanager
    def stage(self, headline: str) -> Iterator[SweepScreen]:
        self.say(headline, "bold")
        with SweepScreen("") as screen:
            yield screen

    def find(self, text: str) -> None:
        """A result in a sentence, without a full stop."""
        self._findings.append(f"{text}.")
        self.say(text, console=self._results)

    def table(self, title: str, names: tuple[str, ...], columns: Mapping[str, tuple[Array, Array]]) -> ReportTable:
        """Print a table; returns it for a section. `columns` maps heading to (value, half of its 95 % interval)."""
        print_intervals(title, names, dict(columns), self._results)
        return interval_table(names, columns, f"{title}.")

    def note(self, **values: Any) -> None:
        """Add to the summary: numbers with seven digits, null where one is not finite."""
        self.summary |= plain_json(values, digits=7)

    def write(self, out: Path, subtitle: str) -> None:
        """Write `report.html` and `summary.json`; raises OSError."""
        short = Section("In short", paragraph(OPENED) + bullets(self._findings))
        render(out / "report.html", "armlink demo", [short, *self.sections], subtitle)
        summary = {"schema": "armlink.demo/1", **self.summary}
        for path in (out / "summary.json", self._json):
            write_json(path, summary)
        self.say(f"done: open {out / 'report.html'}; the numbers are in {out / 'summary.json'}", console=self._results)
