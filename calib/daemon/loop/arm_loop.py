"""The bus loop: drives the bus or listens to it, cycle by cycle; has no web, database or observer."""

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from armlink.bus.arm_hold import ArmHold
from armlink.errors import ArmlinkError, BusFault, Refused
from armlink.link.ends import EndCause, cause_of
from armlink.link.link import Link
from armlink.link.listener import RESOLUTION, Listener
from armlink.link.types import Calibration, Command, Sample, Tell
from armlink.loop.messages import Call, LoopAnswer
from calib.arm.kinematics import gcomp_arm
from calib.daemon.loop.loop_messages import Batch, Down, LoopOptions, Message, Progress, Up
from calib.motion.random_work import WorkMotion, work_pieces
from gcomp.arrays import Array

BATCH_SECONDS = 0.1
"""Time between two batches to the service [s]: the stream's 10 Hz (docs/daemon-api.md)."""
RETRY_SECONDS = 1.0
"""Time between two attempts to open the bus [s]."""
TOUR = WorkMotion(reach=10.0)
"""A tour's moves may span the whole range of a joint [rad]."""
SILENCE_SECONDS = 0.5
"""A bus without SYNC for this time is reported [s]."""


class ArmLoop:
    """`run()` runs the cycles of a tenth of a second and returns messages; `handle` carries out a call.

    A fault of bus or joint is a message, never an exception: the bus is opened again until that succeeds.
    """

    def __init__(self, options: LoopOptions, tell: Tell = lambda text: None) -> None:
        """`tell` is told how far the end of the arm is; it may raise Dropped."""
        self.options, self.tell = options, tell
        self._tour: list[int] | None = None
        self._reported = -1
        self._source: Link | Listener | None = None
        self._hold: ArmHold | None = None
        self._targets: Iterator[Array] | None = None
        self._shift = 0.0
        self._reason: str | None = None
        self._heard = math.inf
        self._real_start: tuple[float, float] | None = None

    @property
    def source(self) -> Link | Listener | None:
        """The open link or listener; None while there is none."""
        return self._source

    def run(self) -> list[Message]:
        """Cycles for BATCH_SECONDS, or one attempt to open the bus."""
        try:
            if self._source is None:
                return [self._open()]
            return self._cycle()
        except ArmlinkError as error:
            self.close(cause_of(error))
            return self._down(str(error))

    def wait(self) -> float:
        """Time to wait before the next run() [s]: 0 while the bus is open."""
        return 0.0 if self._source is not None else RETRY_SECONDS

    def close(self, cause: EndCause = EndCause.DONE) -> None:
        """Bring the arm to its end (`armlink.link.ends`), telling `self.tell` how far that is, and close the bus."""
        source, self._source, self._targets, self._tour = self._source, None, None, None
        try:
            if isinstance(source, Link):
                source.close(cause, self.tell)
            elif source is not None:
                source.__exit__(None, None, None)
        except (ArmlinkError, OSError):
            return  # the bus is gone already: the joints' own deadlines stop them

    def handle(self, call: Call) -> LoopAnswer:
        """Carry out a call; every failure is in the answer."""
        source = self._source
        if source is None:
            return LoopAnswer(call.id, error=BusFault(self._reason or "the bus is not open"))
        try:
            return LoopAnswer(call.id, self._do(source, call))
        except BusFault as error:
            self.close(cause_of(error))
            return LoopAnswer(call.id, error=error)
        except ArmlinkError as error:
            return LoopAnswer(call.id, error=error)

    def _do(self, source: Link | Listener, call: Call) -> Any:
        match call.what:
            case "read_calibration":
                return source.read_calibration(*call.args)
            case "drive_serial":
                return source.drive_serial(*call.args)
            case "write_calibration":
                return source.write_calibration(*call.args)
            case "sweep":
                return self._sweep(source, *call.args)
        raise BusFault(f"the loop knows no call {call.what!r}")

    def _sweep(self, source: Link | Listener, poses: int, seed: int) -> int:
        """Begin a tour of `poses` poses over the whole range, then hold; `run` reports the progress."""
        if not isinstance(source, Link):
            raise Refused(
                "a sweep moves the arm, but this daemon only listens: move the arm with the program that commands it"
            )
        self._tour = [0, poses]
        self._targets = self._touring(source, poses, seed)
        return poses

    def _open(self) -> Message:
        options = self.options
        from armlink.bus.open import open_link_bus
        from armlink.link.bus_load import overload

        bus = options.open_bus() if options.open_bus else open_link_bus(options.bus, options.arm.require_link())
        self._heard = math.inf
        if options.listen_only:
            self._source = Listener(options.arm, bus)
            self._heard = self._source.clock.now()
            return self._up(None)
        link = Link(options.arm, bus, overloaded=overload(options.arm, options.bus))
        self._source = link
        self._hold = self._hold or ArmHold(bus, link.addresses)  # for good: through a passing fault too
        link.start()
        held = [link.read_calibration(joint) for joint in range(link.n)]  # before SDO has to wait for cycles
        sample = link.enable()
        self._shift = link.clock.now() - sample.t
        self._targets = self._motion(link)
        self._real_start = None
        return self._up(held)

    def _up(self, held: list[Calibration] | None) -> Up:
        self._reason = None
        source = self._source
        return Up(
            None if held is None else tuple((each.gain, each.offset, each.record_id) for each in held),
            () if source is None else source.uncalibrated,
        )

    def _down(self, reason: str) -> list[Message]:
        self._reason = reason
        return [Down(reason)]

    def _cycle(self) -> list[Message]:
        source = self._source
        rows = self._listen(source) if isinstance(source, Listener) else self._drive(source)  # type: ignore[arg-type]
        assert source is not None
        if isinstance(source, Listener):
            heard = tuple(source.emergencies)
            source.emergencies.clear()
            messages: list[Message] = [Batch.of(rows, source.stats, heard, source.temperatures)] if rows else []
            return messages + self._silence(source, bool(rows))
        messages = [Batch.of(rows, source.stats, temperature=source.temperatures)]
        if self._tour is not None and self._tour[0] != self._reported:
            self._reported = self._tour[0]
            messages.append(Progress(*self._tour))
            if self._reported >= self._tour[1]:
                self._tour, self._reported = None, -1
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
        while (remaining := end - listener.clock.now()) > RESOLUTION:
            sample = listener.next(remaining)
            while sample is not None:
                rows.append((sample.t, sample, listener.torque_sent, listener.position_sent))
                sample = listener.next(0.0)
            self._keep_pace(listener)
        return rows

    def _silence(self, listener: Listener, heard: bool) -> list[Message]:
        """Report once that no SYNC arrives, and once that it is back."""
        now = listener.clock.now()
        if heard:
            self._heard = now
            if self._reason is not None:
                return [self._up(None)]
            return []
        if now - self._heard <= SILENCE_SECONDS or self._reason is not None:
            return []
        return self._down(f"no SYNC on {listener.bus.channel_info}: is the program that commands the arm running?")

    def _motion(self, link: Link) -> Iterator[Array]:
        """Targets, one per cycle: the present position, or ordinary work if configured."""
        if self.options.work:
            for pose in self._poses(link, self.options.seed, WorkMotion()):
                yield from pose
        here = link.position_sent
        while True:
            yield here

    def _touring(self, link: Link, poses: int, seed: int) -> Iterator[Array]:
        """Targets of a tour over the whole range, then of the motion before it."""
        for done, pose in enumerate(self._poses(link, seed, TOUR), start=1):
            yield from pose
            if self._tour is not None:
                self._tour[0] = done
            if done >= poses:
                break
        yield from self._motion(link)

    def _poses(self, link: Link, seed: int, motion: WorkMotion) -> Iterator[Array]:
        """Endless pieces of motion (K, n), each to another pose with a rest there."""
        arm = gcomp_arm(self.options.arm)
        speed = np.array([joint.max_velocity for joint in self.options.arm.require_link().joints])
        random = np.random.default_rng([seed, 8])
        return work_pieces(link.position_sent, arm.lower, arm.upper, speed, link.period, random, motion)

    def _keep_pace(self, link: Link | Listener) -> None:
        """Run an in-process simulated arm in real time: wait for the machine's clock."""
        if not self.options.pace or link.bus.clock is None:
            return
        now, real = link.clock.now(), time.monotonic()
        if self._real_start is None or real - self._real_start[1] - (now - self._real_start[0]) > 1.0:
            self._real_start = (now, real)  # the machine is too slow: do not catch up
        ahead = (now - self._real_start[0]) - (real - self._real_start[1])
        if ahead > 0:
            time.sleep(ahead)
