"""The bus loop: drives the bus or listens to it, cycle by cycle; knows no web, no database and no observer."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armlink.armfile import ArmFile
from armlink.errors import ArmlinkError, BusFault
from armlink.link import Link
from armlink.listener import Listener
from armlink.sample import Calibration, Command, Sample
from calib.daemon.messages import Array, Batch, Down, Message, Progress, Reply, Request, Up
from calib.daemon.settings import daemon_section

BATCH_SECONDS = 0.1
"""Samples go to the service so often: the snapshot rate of contract 8."""
RETRY_SECONDS = 1.0
"""A bus that is not there is tried again after this time."""
SILENCE_SECONDS = 0.5
"""A bus without SYNC, or joints without readings, for so long is reported."""


@dataclass
class LoopOptions:
    """What the loop needs to know."""

    arm: ArmFile
    bus: str | None = None
    listen_only: bool = False
    work: bool = False
    pace: bool = True
    """In-process simulated arm: keep to the machine's time. Without, simulated time passes as fast as it can."""
    seed: int = 0
    open_bus: Callable[[], Any] | None = field(default=None, repr=False)
    """Gives the bus in tests; by default it is opened by name."""


class Stopped(Exception):
    """The service asked the loop to end in the middle of a sweep."""


class ArmLoop:
    """`run()` makes cycles for a tenth of a second and returns what there is to say; `handle` does what is asked.

    A fault of bus or joint is a message, never an exception: the bus is opened again until it works.
    """

    def __init__(self, options: LoopOptions, report: Callable[[Message], None] | None = None) -> None:
        """`report` takes progress during a sweep, which no `run()` returns; it may raise Stopped."""
        self.options = options
        self._report = report or (lambda message: None)
        self._source: Link | Listener | None = None
        self._targets: Iterator[Array] | None = None
        self._shift = 0.0
        self._said: str | None = None
        self._heard = math.inf
        self._real_start: tuple[float, float] | None = None

    @property
    def source(self) -> Link | Listener | None:
        """The open link or listener, None while there is none."""
        return self._source

    def run(self) -> list[Message]:
        """Cycles for BATCH_SECONDS, or one try to open the bus."""
        try:
            if self._source is None:
                return [self._open()]
            return self._cycle()
        except ArmlinkError as error:
            self.close()
            return self._down(str(error))

    def wait(self) -> float:
        """How long to wait before the next run() [s]: 0 while the bus is there."""
        return 0.0 if self._source is not None else RETRY_SECONDS

    def close(self) -> None:
        """Let go of the bus; joints that were enabled are in quick stop, holding."""
        source, self._source, self._targets = self._source, None, None
        if source is not None:
            try:
                source.__exit__(None, None, None)
            except (ArmlinkError, OSError):
                return  # it is gone already: the joints' own deadlines stop them

    def handle(self, request: Request) -> Reply:
        """Do what is asked; every failure is in the reply."""
        source = self._source
        if source is None:
            return Reply(request.id, error=self._said or "the bus is not open", status=BusFault.exit_status)
        try:
            return Reply(request.id, self._do(source, request))
        except BusFault as error:
            self.close()
            return Reply(request.id, error=str(error), status=error.exit_status)
        except ArmlinkError as error:
            return Reply(request.id, error=str(error), status=error.exit_status)

    def _do(self, source: Link | Listener, request: Request) -> Any:
        arguments = request.arguments
        if request.what == "read":
            return source.read_calibration(arguments["joint"])
        if request.what == "write":
            return source.write_calibration(**arguments)
        if request.what == "sweep":
            return self._sweep(source, Path(arguments["out"]))
        raise BusFault(f"the loop knows no request {request.what!r}")

    def _sweep(self, source: Link | Listener, out: Path) -> str:
        """One pass of sweeps without a reference mass; what it read is in `out`."""
        from calib.runner import run_sweep

        if not isinstance(source, Link):
            raise BusFault("a sweep needs the bus: this daemon only listens")
        self._targets = None

        def progress(done: int, total: int, remaining: float, doing: str) -> None:
            self._report(Progress(done, total, remaining, doing))

        run_sweep(source, self.options.arm, out, progress=progress)
        return str(out)

    def _open(self) -> Message:
        options = self.options
        from armlink.bus import open_bus

        section = options.arm.require_link()
        bus = options.open_bus() if options.open_bus else open_bus(options.bus, section.bus)
        self._heard = math.inf
        if options.listen_only:
            self._source = Listener(options.arm, bus)
            self._heard = self._source.clock.now()
            return self._up(None)
        link = Link(options.arm, bus)
        self._source = link
        link.start()
        sample = link.enable()
        held = [link.read_calibration(joint) for joint in range(link.n)]
        self._shift = link.clock.now() - sample.t
        self._targets = self._motion(link)
        self._real_start = None
        return self._up(held)

    def _up(self, held: list[Calibration] | None) -> Up:
        self._said = None
        return Up(None if held is None else tuple((each.gain, each.offset, each.record_id) for each in held))

    def _down(self, reason: str) -> list[Message]:
        self._said = reason
        return [Down(reason)]

    def _cycle(self) -> list[Message]:
        source = self._source
        rows = self._listen(source) if isinstance(source, Listener) else self._drive(source)  # type: ignore[arg-type]
        assert source is not None
        messages: list[Message] = [Batch.of(rows, source.stats)] if rows else []
        if isinstance(source, Listener):
            return messages + self._silence(source, bool(rows))
        return messages

    def _drive(self, link: Link) -> list[tuple[float, Sample, Array, Array]]:
        rows = []
        if self._targets is None:
            self._targets = self._motion(link)
        for _ in range(max(1, round(BATCH_SECONDS / link.period))):
            sample = link.cycle(Command.hold(next(self._targets)))
            rows.append((sample.t + self._shift, sample, link.torque_sent, link.position_sent))
            self._keep_pace(link)
        return rows

    def _listen(self, listener: Listener) -> list[tuple[float, Sample, Array, Array]]:
        rows = []
        end = listener.clock.now() + BATCH_SECONDS
        while (remaining := end - listener.clock.now()) > 0:
            sample = listener.next(remaining)
            if sample is not None:
                rows.append((sample.t, sample, listener.torque_sent.copy(), listener.position_sent.copy()))
        return rows

    def _silence(self, listener: Listener, heard: bool) -> list[Message]:
        """Say once that nobody sends SYNC, and when somebody does again."""
        now = listener.clock.now()
        if heard:
            self._heard = now
            if self._said is not None:
                return [self._up(None)]
            return []
        if now - self._heard <= SILENCE_SECONDS or self._said is not None:
            return []
        return self._down(f"no SYNC on {listener.bus.channel_info}: is the arm's controller running?")

    def _motion(self, link: Link) -> Iterator[Array]:
        """Targets, one a cycle: where the arm stands, or ordinary work where that was asked for."""
        start = link.position_sent
        if self.options.work:
            from calib.description import gcomp_arm
            from calib.work import work_targets

            arm = gcomp_arm(self.options.arm)
            speed = np.array([joint.max_velocity for joint in self.options.arm.require_link().joints])
            random = np.random.default_rng([self.options.seed, 8])
            yield from work_targets(start, arm.lower, arm.upper, speed, link.period, random)
        while True:
            yield start

    def _keep_pace(self, link: Link) -> None:
        """An in-process arm's time is as fast as the machine: wait for the machine's clock."""
        if not self.options.pace or getattr(link.bus, "clock", None) is None:
            return
        import time

        now, real = link.clock.now(), time.monotonic()
        if self._real_start is None or real - self._real_start[1] - (now - self._real_start[0]) > 1.0:
            self._real_start = (now, real)  # the machine is slower than the arm: do not make up for it
        ahead = (now - self._real_start[0]) - (real - self._real_start[1])
        if ahead > 0:
            time.sleep(ahead)


def loop_options(arm: ArmFile, bus: str | None, listen_only: bool) -> LoopOptions:
    """Options of an arm file's daemon section; `bus` as --bus has it."""
    return LoopOptions(arm, bus, listen_only, work=daemon_section(arm).work)
