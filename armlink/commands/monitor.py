"""Shows an arm's joints live: position, torque, state, age, bus load; commands nothing."""

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from armlink.commands.options import Arm, Json, LeRobot, OtherBus, Ros2

if TYPE_CHECKING:
    from rich.console import Console, Group

    from armlink.arm_file import ArmFile
    from armlink.link.types import Sample
    from armlink.monitor.monitor import Monitor, View

REFRESH_SECONDS = 0.2
ONCE_SECONDS = 0.5
STREAM_SECONDS = 0.02
COLUMNS = ("joint", "node", "position [rad]", "torque [N·m]", "motor [N·m]", "state", "NMT", "age [s]")


def monitor(
    arm: Arm,
    bus: OtherBus = None,
    ros2: Ros2 = None,
    lerobot: LeRobot = None,
    once: Annotated[bool, typer.Option("--once", help="Show one table, then end.")] = False,
    cycles: Annotated[
        int, typer.Option(min=0, help="End after this many refreshes (5 a second); 0: run until Ctrl-C.")
    ] = 0,
    sync: Annotated[bool, typer.Option("--sync", help="Start the nodes and send SYNC, if no other host does.")] = False,
    stats: Annotated[
        bool,
        typer.Option(
            "--stats", help="Show period, jitter, latency (p50, p99, p99.9), missed cycles and exact bus load."
        ),
    ] = False,
    foxglove: Annotated[
        int | None, typer.Option(min=0, max=65535, metavar="PORT", help="Serve readings to Foxglove; 0: a free port.")
    ] = None,
    rerun: Annotated[
        int | None,
        typer.Option(min=1, max=65535, metavar="PORT", help="Send readings to a Rerun viewer on this machine."),
    ] = None,
    json: Json = None,
) -> int:
    """Show what an arm's joints send; exit status 3 if no joint is heard.

    It listens while a host runs the arm. Torque is scaled by the arm file's rated torques, position by 2^20
    units a turn. With --stats the interface's time stamps are used (with --sync, the monitor's clock); latency is the
    time from SYNC to the reading of the last joint, and the load includes stuff bits. With --foxglove 8765 open
    ws://localhost:8765 in Foxglove: /joint_states and /motor_states as in a recording, 50 times a second. With --rerun
    9876 the same readings go to the viewer that the command rerun starts.

    Example: armlink monitor sarcos --bus socketcan:vcan0 --stats
    """
    from rich.live import Live

    from armlink.arm_file import load_arm
    from armlink.bus.listening.joint_messages import remarks_of, silence_of
    from armlink.bus.open import open_link_bus
    from armlink.commands.options import stated_bus
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from armlink.errors import BusFault
    from armlink.monitor.monitor import Monitor

    arm_file = load_arm(arm)
    opened = open_link_bus(stated_bus(bus, ros2, lerobot), arm_file.require_link())
    console = PlainConsole()
    answer: dict[str, Any] = {}
    title = f"{arm_file.name} on {opened.channel_info}"
    try:
        watcher = Monitor(arm_file, opened, sync, stats)
        refreshes = 1 if once else cycles
        shown = 0
        with (
            Live(console=console, auto_refresh=False, transient=True) as live,
            _stream(arm_file, foxglove, rerun, console) as send,
        ):
            try:
                while not refreshes or shown < refreshes:
                    answer = watcher.describe(_watch(watcher, ONCE_SECONDS if once else REFRESH_SECONDS, send))
                    answer["remarks"] = remarks_of(opened)
                    shown += 1
                    if console.is_terminal:
                        live.update(_table(title, answer), refresh=True)
            finally:
                live.update("")  # a table that is higher than the terminal would leave lines behind
    finally:
        opened.shutdown()
        if answer:
            out = results(json)
            out.print(_table(title, answer))
            out.print(f"{sum(map(_is_heard, answer['joints']))} of {len(answer['joints'])} joints are heard")
            write_json(json, {"arm": arm_file.name, "serial": arm_file.serial, **answer})
    if not any(map(_is_heard, answer["joints"])):
        why = silence_of(opened, "does a host send SYNC? (--sync sends it)")
        raise BusFault(f"{title}: no joint sends data: {why}")
    return 0


def _is_heard(joint: dict[str, Any]) -> bool:
    return joint["state"] is not None or joint["position"] == joint["position"]


@contextlib.contextmanager
def _stream(
    arm: "ArmFile", foxglove: int | None, rerun: int | None, console: "Console"
) -> "Iterator[Callable[[Sample], None] | None]":
    """Where samples go besides the table; None: nowhere."""
    names = tuple(joint.name for joint in arm.require_link().joints)
    with contextlib.ExitStack() as open_streams:
        sends: list[Callable[[Sample], None]] = []
        if foxglove is not None:
            from armlink.monitor.streams import FoxgloveStream

            served = open_streams.enter_context(FoxgloveStream(arm.name, names, foxglove))
            console.print(f"Foxglove: open ws://localhost:{served.port}")
            sends.append(served.send)
        if rerun is not None:
            from armlink.monitor.streams import RerunStream

            sends.append(open_streams.enter_context(RerunStream(arm.name, names, rerun)).send)

        def send_all(sample: "Sample") -> None:
            for send in sends:
                send(sample)

        yield send_all if sends else None


def _watch(watcher: "Monitor", seconds: float, send: "Callable[[Sample], None] | None") -> "View":
    """Watch for `seconds`; with `send` in short pieces, each sent on. The view is of the last piece."""
    if send is None:
        return watcher.watch(seconds)
    for _ in range(round(seconds / STREAM_SECONDS)):
        view = watcher.watch(STREAM_SECONDS)
        send(view.sample)
    return view


def _table(title: str, answer: dict[str, Any]) -> "Group":
    from rich.box import SIMPLE
    from rich.console import Group
    from rich.table import Table

    from armlink.drives.family import family

    table = Table(*COLUMNS, box=SIMPLE, title=title)
    for column in (1, 2, 3, 4, 7):
        table.columns[column].justify = "right"
    for joint in answer["joints"]:
        table.add_row(
            joint["joint"],
            str(joint.get("node", joint.get("id", "—"))),
            _number(joint["position"], "{:+.4f}"),
            _number(joint["torque"], "{:+.2f}"),
            _number(joint["motor_torque"], "{:+.2f}"),
            joint["state"] or "—",
            joint.get("nmt") or "—",
            _number(joint["age"], "{:.1f}"),
        )
    bus = answer["bus"]
    line = f"SYNC {bus['rate_hz']:.1f} Hz, load {bus['load']:.1%}, {bus['frames']} frames, {bus['errors']} errors"
    if all(family(joint["family"]).traits.heard for joint in answer["joints"]):
        line = "; ".join((f"{bus['rate_hz']:.1f} readings a second", *answer["remarks"]))
    emergencies = [f"{each['joint']}: {each['code']} {each['meaning']}" for each in answer["emergencies"][-5:]]
    if bus["dropped"]:
        line += f", {bus['dropped']} lost because this process read too slowly"
    misplaced = [f"{each['joint']}: {each['misplaced']}" for each in answer["joints"] if each["misplaced"]]
    return Group(table, line, *misplaced, *emergencies, *_cycle(answer.get("cycle")))


def _cycle(cycle: dict[str, Any] | None) -> list[str]:
    """Figures of the cycle and the histogram of its latency, as lines."""
    if cycle is None:
        return []
    if not cycle["cycles"]:
        return ["no whole cycle yet"]
    lines = [
        f"{cycle['cycles']} cycles, {cycle['missed']} missed ({cycle['missed'] / cycle['cycles']:.3%}); period "
        f"{cycle['period_ms']:.3f} ms, jitter {cycle['jitter_ms']:.3f} ms, longest {cycle['longest_period_ms']:.3f} ms",
        f"SYNC to the last reading: p50 {cycle['latency_p50_ms']:.3f}, p99 {cycle['latency_p99_ms']:.3f}, "
        f"p99.9 {cycle['latency_p999_ms']:.3f}, longest {cycle['latency_max_ms']:.3f} ms",
        f"bus {cycle['load']:.1%} busy, stuff bits included: {cycle['bus_ms_per_cycle']:.3f} ms of each cycle",
    ]
    most = max((count for _, count in cycle["histogram"]), default=1)
    return lines + [
        f"{f'≤ {edge:g} ms' if edge < float('inf') else 'more':>10} {count:8d} {'█' * round(40 * count / most)}"
        for edge, count in cycle["histogram"]
    ]


def _number(value: float, form: str) -> str:
    return form.format(value) if abs(value) < float("inf") else "—"
