"""Terminal output of the sweep commands: progress with time left, plans and results as tables."""

import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, Progress
from rich.table import Column, Table

from armlink.arm_file import ArmFile
from armlink.commands.plain_console import PlainColumn, PlainConsole
from armlink.commands.plain_console import confirm as ask_to_confirm
from armlink.errors import Stall
from armlink.link.lateness import Lateness
from calib.plan.types import SCOUT, SCOUT_TITLE, SweepPlan, reading_name
from calib.report.tables import interval_table

if TYPE_CHECKING:
    from calib.dataset import SweepData
    from calib.sweep.preflight import Preflight

SPACE_CLEAR = "Is its space clear?"
_CONSOLE = PlainConsole()
"""For progress and warnings."""


class SweepScreen:
    """A progress bar with readings done, time left and what is being done; a context manager."""

    def __init__(self, title: str, line_period: float = 5.0) -> None:
        """With `title` before the bar, or above it on a narrow terminal; elsewhere a line in so many seconds."""
        above = bool(title) and _CONSOLE.width < 100  # title, bar and reading do not fit in a line
        if above:
            _CONSOLE.print(title)
        columns = (
            PlainColumn("{task.description}"),
            BarColumn(bar_width=min(40, _CONSOLE.width // 8)),
            PlainColumn("{task.completed:.0f}/{task.total:.0f}"),
            PlainColumn("{task.fields[text]}"),
        )
        self._progress = Progress(*columns, console=_CONSOLE, transient=False, disable=not _CONSOLE.is_terminal)
        self._title, self._told, self._period = title, time.monotonic(), line_period
        self._task = self._progress.add_task("" if above else title, total=1, text="connecting")

    def update(self, done: int, total: int, seconds_left: float, text: str) -> None:
        self._update(done, total, f"{int(seconds_left) // 60}:{int(seconds_left) % 60:02d} left", text)

    def count(self, done: int, total: int, what: str = "poses") -> None:
        self._update(done, total, "", what)

    def _update(self, done: int, total: int, left: str, text: str) -> None:
        """On the bar; where there is no terminal, a line now and then."""
        told = [each for each in (left, text) if each]
        self._progress.update(self._task, completed=done, total=total, text="  ".join(told))
        if self._progress.disable and time.monotonic() - self._told >= self._period:
            self._told = time.monotonic()
            _CONSOLE.print("  ".join([*[self._title] * bool(self._title), f"{done}/{total}", *told]))

    def on_stall(self, keep_going: int) -> Callable[[Stall], bool]:
        """An OnStall that goes on by itself so often, then asks; without a terminal it then gives up."""
        left = keep_going

        def on_stall(stall: Stall) -> bool:
            nonlocal left
            self.say(f"{stall}: the joints were stopped")
            if left > 0:
                left -= 1
                self.say(
                    f"enabling the joints again and repeating the reading (up to {left} more times without asking)"
                )
                return True
            if sys.stdin is None or not sys.stdin.isatty():
                return False
            self._progress.stop()
            again = ask_to_confirm("Enable the joints again and repeat the reading?", abort=False)
            self._progress.start()
            return again

        return on_stall

    def say(self, text: str) -> None:
        _CONSOLE.print(text)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._progress.stop()


def confirm(motion: str, question: str, agreed: bool = False) -> list[str]:
    """Say what will move and ask a person at the terminal, unless it was `agreed` before; raises Declined where the
    answer is no.

    Without a terminal nobody is asked, and the lines returned say so: print them just before the arm moves.
    """
    if agreed:
        return []
    if sys.stdin is not None and sys.stdin.isatty():
        ask_to_confirm(f"{motion}. {question}")
        return []
    return [f"{motion}. {question} There is no terminal to ask on: the arm moves now"]


def print_preflight(found: "Preflight", console: PlainConsole) -> None:
    """Print the findings of the pre-flight, one row per joint."""
    measured = ["torque noise [N·m]", "torque at rest [N·m]", "drive [°C]"]
    pushed = np.isfinite(found.stops).any()
    table = Table("joint", *measured, *(["lower stop [rad]", "upper stop [rad]"] if pushed else []))
    table.title = "Before the first reading"
    for joint, name in enumerate(found.names):
        stops = [
            "not pushed" if np.isnan(at) else f"{at:.3f} (arm file {wanted:.3f})"
            for at, wanted in zip(found.stops[joint], found.expected[joint], strict=True)
            if pushed
        ]
        warm = "not reported" if np.isnan(found.temperature[joint]) else f"{found.temperature[joint]:.0f}"
        table.add_row(name, f"{found.noise[joint]:.3g}", f"{found.torque[joint]:.3g}", warm, *stops)
    console.print(table)


def print_plan(arm: ArmFile, plan: SweepPlan, console: PlainConsole) -> None:
    """The sweeps of a plan as a table: where each joint rests, what presses it, range and lever of gravity."""
    title, short = f"{arm.name}: {len(plan.sweeps)} sweeps", _short(arm.joint_names, console.width // 2)
    table = Table(
        Column("sweep", overflow="fold"), "from … to", "Γ/g", *short, title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    rows = list[list[str]]()
    for sweep in plan.sweeps:
        cells = []
        for joint in range(len(arm.joint_names)):
            if joint == sweep.joint:
                cells.append("↔")
            elif sweep.servo[joint]:
                cells.append(f"={sweep.rest[joint]:.2f}")
            else:
                end = "▲" if sweep.stops[joint] > 0 else "▼"
                cells.append(end if sweep.bias is None else f"{end}{sweep.bias[joint]:+.1f}")
        table.add_row(sweep.name, f"{sweep.steps[0]:.2f} … {sweep.steps[-1]:.2f}", f"{sweep.lever:.2f}", *cells)
        rows.append(cells)
    console.print(table)
    if short != list(arm.joint_names):
        columns = (f"{number}\u00a0{name}" for number, name in zip(short, arm.joint_names, strict=True))
        console.print(f"columns: {', '.join(columns)}")
    signs, pressed = {cell[0] for cells in rows for cell in cells}, any(sweep.bias for sweep in plan.sweeps)
    legend = ["Γ/g is the share of gravity that acts on the joint", "↔ sweeps"]
    if signs & {"▲", "▼"}:
        legend.append("▲ ▼ rests on its upper or lower stop" + ", pressed with the torque [N·m]" * pressed)
    if "=" in signs:
        legend.append("= held by its position loop [rad]")
    console.print("; ".join(legend))
    for note in plan.notes:
        console.print(note, style="yellow")


def unsettled_lines(data: "SweepData") -> list[str]:
    """In one line, the readings taken while the arm had not settled; empty if there are none."""
    if not data.unsettled:
        return []
    places = [
        f"the {SCOUT_TITLE}" if sweep == SCOUT else sweep
        for sweep in dict.fromkeys(reading.sweep for reading in data.unsettled)
    ]
    return [
        (
            f"{len(data.unsettled)} of {len(data.readings)} readings had not settled when their time was up, in "
            f"{', '.join(places)}: these readings count less. Does a joint swing under its position loop?"
        )
    ]


def stall_lines(data: "SweepData") -> list[str]:
    """In one line, how often the joints had to be stopped; nothing if they never were."""
    if not data.stalls:
        return []
    places = list(dict.fromkeys(_place(stall.reading) for stall in data.stalls))
    often = "once" if len(data.stalls) == 1 else f"{len(data.stalls)} times"
    return [f"the joints were stopped {often}; these readings were repeated: {'; '.join(places)}"]


def _place(reading: str) -> str:
    """The place in the note of a stall, for people: `scout 6`, `elbow.1 3`, or a whole sweep."""
    sweep, _, number = reading.rpartition(" ")
    return reading_name(sweep, int(number) - 1) if number.isdigit() else reading


def warn_late(arm: ArmFile, lateness: Lateness) -> None:
    """A line if this machine was late enough to come near the arm's deadline."""
    warning = lateness.near(arm.require_link().deadline, arm.argument)
    print_lines([warning] if warning else [], "yellow")


def _short(names: tuple[str, ...], width: int) -> list[str]:
    """The numbers of names such as joint_1, joint_2; other names where they fit, else numbers from the base."""
    begin = names[0].rstrip("0123456789")
    short = [name.removeprefix(begin) for name in names]
    if all(each.isdigit() for each in short):
        return short
    return list(names) if len(" ".join(names)) <= width else [str(number) for number in range(1, len(names) + 1)]


def print_intervals(
    title: str, names: tuple[str, ...], columns: dict[str, tuple[np.ndarray, np.ndarray]], console: PlainConsole
) -> None:
    """Values with the half width of their 95 % interval, a row a joint; `columns` maps heading to (value, half)."""
    made = interval_table(names, columns)
    table = Table(*made.header, title=title)
    for row in made.rows:
        table.add_row(*(cell.replace("\u00a0", " ") for cell in row))
    console.print(table)


def print_lines(lines: list[str], style: str | None = None, console: PlainConsole = _CONSOLE) -> None:
    """Print lines without a style, or in a style of rich such as `yellow`; by default on standard error."""
    for line in lines:
        console.print(line, style=style)
