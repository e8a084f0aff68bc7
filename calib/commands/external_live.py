"""External torque of an arm that another program commands, while it works: a table, lines, or lines of JSON."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from armlink.commands.output import json_lines
from armlink.commands.plain_console import PlainConsole, results
from armlink.errors import BusFault
from calib.commands.heard_samples import WAIT_SECONDS, heard_samples
from calib.external.listening import ExternalRow, LiveExternal
from calib.external.tables import AXES, event_of, event_text, wrench_of
from gcomp.external.external_model import NORMAL_95

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from armlink.link.listener import Listener
    from armlink.link.types import Sample
    from calib.external.listening import Learned
    from gcomp.arrays import Array

    Heard = tuple[float, Array, Array, Array, Array]
    """Time [s]; positions, velocities, torques, and the drives' temperatures [°C] (n,)."""

LINE_SECONDS = 1.0
"""Between two lines on a pipe [s]."""


def follow(
    arm: "ArmFile", source: str | None, learned: "Learned", seconds: float, json_file: Path | None, foxglove: int | None
) -> None:
    """Report until the time is over or Ctrl-C. Raises BusFault if no torque of the learned kind is heard."""
    live, out = LiveExternal(learned), results(json_file)
    with (
        json_lines(json_file) as write,
        _served(arm, foxglove, out) as serve,
        _shown(out) as show,
        contextlib.suppress(KeyboardInterrupt),
    ):
        write({"schema": "armlink.external-live/1", **learned.described()})
        rows, heard, first, shown, newest = 0, 0, 0.0, -np.inf, None
        for samples in heard_samples(arm, source, seconds, _channels(learned.listener.channel)):
            if samples:
                first, heard = samples[0][0] if not heard else first, heard + len(samples)
                t, position, velocity, torque, warmth = (np.array(column) for column in zip(*samples, strict=True))
                for event in live.take(t, position, velocity, torque, warmth[-1]):
                    told = event_of(event, arm.joint_names) | {"t": event.t - first, "told": event.told - first}
                    out.print(f"{told['t']:9.2f} s  {event_text(told)}")
                    write({"event": told})
            if live.row is not None and live.row is not newest:
                newest, rows = live.row, rows + 1
                write(_line(live, newest, first))
                serve(live, newest)
            now = time.monotonic()
            if newest is not None and now - shown >= (WAIT_SECONDS if out.is_terminal else LINE_SECONDS):
                shown = now
                show(live, newest, first)
    if heard and not rows:
        raise BusFault(
            f"{heard} samples of {arm.name} were heard, but the learned model needs position and "
            f"{learned.listener.channel} of all joints within a second, and they never came"
        )
    if newest is not None and out.is_terminal:
        out.print(_table(live, newest, first))
    out.print(f"{heard} samples were heard")


def _channels(channel: str) -> Any:
    def channels(listener: "Listener", sample: "Sample") -> "Heard":
        torque = listener.torque_sent if channel == "torque_command" else getattr(sample, channel)
        return sample.t, sample.position, sample.velocity, torque, listener.temperatures

    return channels


def _line(live: LiveExternal, row: ExternalRow, first: float) -> dict[str, Any]:
    return {
        "t": row.t - first,
        "torque": row.external.tolist(),
        "bound": (NORMAL_95 * row.std).tolist(),
        **_wrench(live),
        "load": live.load,
    }


def _wrench(live: LiveExternal) -> dict[str, list[float]]:
    told = live.wrench()
    assert told is not None
    return wrench_of(told)


@contextlib.contextmanager
def _served(
    arm: "ArmFile", port: int | None, out: PlainConsole
) -> "Iterator[Callable[[LiveExternal, ExternalRow], None]]":
    """Where each row goes besides."""
    if port is None:
        yield lambda live, row: None
        return
    from armlink.monitor.streams import ExternalStream

    with ExternalStream(arm.name, arm.joint_names, "base", port) as stream:
        out.print(f"Foxglove: open ws://localhost:{stream.port}")

        def send(live: LiveExternal, row: ExternalRow) -> None:
            told = live.wrench()
            assert told is not None
            stream.send(row.external, row.std, told.value[0])

        yield send


@contextlib.contextmanager
def _shown(out: PlainConsole) -> "Iterator[Any]":
    """Where the newest row is shown: a table that is renewed, or on a pipe lines."""
    if not out.is_terminal:
        yield lambda live, row, first: out.print(_as_text(live, row, first))
        return
    with Live(console=out, auto_refresh=False, transient=True) as screen:
        try:
            yield lambda live, row, first: screen.update(_table(live, row, first), refresh=True)
        finally:
            screen.update("")  # a table that is higher than the terminal would leave lines behind


def _joints(live: LiveExternal, row: ExternalRow) -> Iterator[tuple[str, float, float]]:
    """Name, external torque and half width of its 95 % interval [N·m]."""
    bounds = NORMAL_95 * row.std
    return zip(live.learned.listener.model.arm.names, row.external.tolist(), bounds.tolist(), strict=True)


def _as_text(live: LiveExternal, row: ExternalRow, first: float) -> str:
    joints = "  ".join(f"{name} {torque:+.2f} ± {bound:.2f}" for name, torque, bound in _joints(live, row))
    return f"{row.t - first:9.2f} s  {joints} N·m; {'; '.join(_forces(live))}"


def _forces(live: LiveExternal) -> list[str]:
    """Force and moment at the frame along the axes of the base, with 95 % intervals."""
    told, frame = _wrench(live), live.learned.frame
    return [
        f"{name} at {live.learned.listener.model.arm.names[frame.link]}: "
        + ", ".join(_along(*each) for each in zip(AXES, told[name], told[f"{name}_std"], strict=True))
        + f" {unit}"
        for name, unit in (("force", "N"), ("moment", "N·m"))
    ]


def _along(axis: str, value: float, std: float) -> str:
    return f"{axis} {value:+.1f} ± {NORMAL_95 * std:.1f}" if np.isfinite(std) else f"{axis} not determined"


def _table(live: LiveExternal, row: ExternalRow, first: float) -> Group:
    table = Table("joint", "external torque [N·m]", "95 % bound ± [N·m]", title=f"{row.t - first:.1f} s")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, torque, bound in _joints(live, row):
        beyond = "bold" if abs(torque) > bound else ""
        table.add_row(name, Text(f"{torque:+.2f}", style=beyond), f"{bound:.2f}")
    return Group(table, *_forces(live), f"taken up: {live.load:+.2f} kg")
