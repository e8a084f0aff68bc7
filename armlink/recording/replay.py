"""Replay of raw logs and recordings: decoded, shown, or sent onto a virtual bus as the joints would send them."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.frame_log import READ_SUFFIXES, LogBus, LogReader, is_log
from armlink.bus.open import is_virtual, open_bus, parse_bus
from armlink.bus.port import Port, Stamped
from armlink.clock import Clock, MonotonicClock
from armlink.drives.orders import Reading
from armlink.errors import BadInput
from armlink.link.joints.groups import make_groups
from armlink.recording.recorder import Recorder
from armlink.recording.recording import Recording

if TYPE_CHECKING:
    from rich.console import Console

_REFRESH = 0.2  # [s]


def recording_of_log(arm: ArmFile, path: Path) -> Recording:
    """Decode a raw log with the recorder's decoding; `warning` says where the log is truncated. Raises BadInput."""
    bus = LogBus(path)
    recorder = Recorder(arm, bus)
    times: list[float] = []
    channels: dict[str, list[Array]] = {}
    for t, row in recorder.rows(math.inf):
        times.append(t)
        for name, values in row.items():
            channels.setdefault(name, []).append(values)
    warning = bus.reader.warning
    if len(times) < 2:
        why = "; ".join(each for each in (_why_no_cycle(arm, bus.reader), warning) if each)
        raise BadInput(f"{path}: {len(times)} whole cycles of {arm.name} in {bus.reader.count} frames: {why}")
    stacked = {name: np.array(rows) for name, rows in channels.items()}
    return Recording(t=np.array(times), names=recorder.names, warning=warning, **stacked).check(str(path))


def _why_no_cycle(arm: ArmFile, log: LogReader) -> str:
    """The frames of an arm that a log lacks, in words."""
    if not log.ids:
        return f"no frame could be read: its content is not what its suffix says ({', '.join(READ_SUFFIXES)})"
    names, absent = [joint.name for joint in arm.require_link().joints], []
    for group in make_groups(arm):
        owners = group.drives.reading_ids()
        for drive, place in enumerate(group.places):
            if not any(can_id in log.ids for can_id, owner in owners.items() if owner == drive):
                absent.append(f"{names[place]} ({arm.require_link().joints[place].settings.address})")
        paced = group.drives.cycle_ids()
        if paced and not any(can_id in log.ids for can_id in paced):
            absent.append(f"SYNC ({min(paced):03X}h)")
    if not absent:
        return "the log has frames of every joint, but no cycle with frames of all joints"
    seen = ", ".join(f"{can_id & 0x1FFFFFFF:03X}h" for can_id in sorted(log.ids)[:12])
    return f"no frame comes from {', '.join(absent)}; the log has the frames {seen}{' …' if len(log.ids) > 12 else ''}"


def play_onto(arm: ArmFile, source: Path, recording: Recording, spec: str, speed: float) -> int:
    """Send SYNC and the joints' frames onto a virtual bus at `speed` times their pace; returns the number of frames.

    Raises BadInput for a bus that is not virtual, BusFault if it cannot be opened or takes no frames.
    """
    if not is_virtual(parse_bus(spec)):
        raise BadInput(
            f"bus {spec}: replay is possible only on a virtual bus: virtual:…, udp_multicast:… or socketcan:vcan…"
        )
    bus = open_bus(spec, arm.require_link().bus)
    try:
        frames = frames_of_log(arm, source) if is_log(source) else frames_of_recording(arm, recording)
        return _play(frames, bus.open_port(), MonotonicClock(), speed)
    finally:
        bus.shutdown()


def frames_of_log(arm: ArmFile, path: Path) -> Iterator[Stamped]:
    """Time [s], identifier and data of SYNC and of the drives' frames in a log; no commands, requests or NMT."""
    groups = make_groups(arm)
    taken = {can_id for group in groups for can_id in (*group.drives.routes(), *group.drives.cycle_ids())}
    for stamp, can_id, data in LogReader(path).frames():
        if can_id in taken:
            yield stamp / 1e6, can_id, data


def frames_of_recording(arm: ArmFile, recording: Recording) -> Iterator[Stamped]:
    """Time [s], identifier and data of the frames by which an arm's drives would have sent a recording.

    The frame of a missing reading is left out. Raises BadInput if the number of joints differs, or for a family whose
    frames cannot be made from readings.
    """
    joints = arm.require_link().joints
    if recording.n != len(joints):
        raise BadInput(f"the recording has {recording.n} joints, but {arm.name} has {len(joints)}")
    groups = make_groups(arm)
    for group in groups:
        group.drives.replayed(True, [])  # drives that cannot be replayed say so before anything is sent
    nothing = np.full_like(recording.position, math.nan)
    torque = nothing if recording.torque is None else recording.torque
    motor = nothing if recording.motor_torque is None else recording.motor_torque
    velocity = nothing if recording.velocity is None else recording.velocity
    for row, t in enumerate((recording.t - recording.t[0]).tolist()):
        columns = (recording.position[row], velocity[row], motor[row], torque[row])
        for group in groups:
            readings = [
                Reading(joint, *[float(column[place]) for column in columns])  # type: ignore[arg-type]
                for joint, place in enumerate(group.places)
            ]
            for can_id, data in group.drives.replayed(row == 0, readings):
                yield t, can_id, data


def show(recording: Recording, console: "Console", speed: float, clock: Clock | None = None) -> None:
    """Show a recording as a table that follows its time at `speed` times its pace; 0: only the last row."""
    from rich.live import Live

    clock = clock or MonotonicClock()
    start, times = clock.now(), recording.t - recording.t[0]
    step = max(1, int(np.searchsorted(times, _REFRESH * speed)))
    with Live(console=console, auto_refresh=False, transient=True) as live:
        for row in range(0, times.size, step) if speed > 0 and console.is_terminal else ():
            clock.sleep_until(start + float(times[row]) / speed)
            live.update(_table(recording, row), refresh=True)
    console.print(_table(recording, times.size - 1))


def _play(frames: Iterator[Stamped], port: Port, clock: Clock, speed: float) -> int:
    start, count = clock.now(), 0
    for t, can_id, data in frames:
        if speed > 0:
            clock.sleep_until(start + t / speed)
        port.send(can_id, data)
        count += 1
    return count


def _table(recording: Recording, row: int) -> Any:
    from rich.box import SIMPLE
    from rich.table import Column, Table
    from rich.text import Text

    channels = recording.channels()
    table = Table("joint", *(Column(Text(name.replace("_", "\n"))) for name in channels), box=SIMPLE)
    table.title = f"t = {recording.t[row]:.2f} s of {recording.t[-1]:.2f} s"
    for joint, name in enumerate(recording.names):
        table.add_row(name, *(f"{values[row, joint]:+.4f}" for values in channels.values()))
    return table
