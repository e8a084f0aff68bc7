"""A link whose cycles are made in a process of its own: the job sends commands ahead and gets the samples back."""

import contextlib
import pickle
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Self

import numpy as np

from armlink.arm_file import ArmFile
from armlink.channel import Closed
from armlink.errors import BusFault
from armlink.link.ends import EndCause, cause_of
from armlink.link.link import Link
from armlink.link.park import park
from armlink.link.types import Command, Controller, Sample, Samples, Setpoints, Stats, Tell
from armlink.loop.cycle_process import CycleProcess, RemoteControllers, numbers, remote
from armlink.loop.ending import TELL_INTERVAL
from armlink.loop.messages import Call, JobSignal, LoopAnswer, Open, Play, RunController, Stopped, Told, unpack
from armlink.loop.realtime import Realtime
from armlink.termination import Presses, end_logger

CHUNK_ROWS = 50
"""Rows of one message: unpickling more would hold up a cycle."""
ANSWER_SECONDS = 60.0
"""Longest wait for an answer of the loop [s]; starting an arm takes some seconds."""
SAMPLE_SECONDS = 5.0
"""Longest wait for a sample of an enabled arm [s]."""


class RemoteLink(CycleProcess, RemoteControllers):
    """For a job as `Link`, which documents what is not documented here. Not for several threads."""

    def __init__(self, arm: ArmFile, bus: str | None = None) -> None:
        """Start the process and open the bus; raises BadInput, BusFault."""
        self.arm = arm
        section = arm.require_link()
        self.names = tuple(joint.name for joint in section.joints)
        self.n, self.rate, self.period = len(self.names), section.rate, 1.0 / section.rate
        self._samples: deque[tuple[int, int, bytes]] = deque()
        self._stopped: Stopped | None = None
        self._answers: dict[int, LoopAnswer] = {}
        self._in_force: Command | None = None
        self.torque_sent = self.position_sent = np.full(self.n, np.nan)
        """As Link has them, but of the newest sample taken."""
        self.position_step = np.full(self.n, np.inf)
        self._told = self._heard = time.monotonic()
        self._tell_on: Tell = lambda text: None
        super().__init__(Open(arm, bus))
        try:
            self.realtime: Realtime = self._answer(0).result()
            """Real-time permissions of the process that makes the cycles."""
        except BaseException:
            self._end(EndCause.FAILED)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, tb: object) -> None:
        """As Link: the process brings the arm to its end, whatever the error, and closes the bus."""
        self._end(cause_of(error if isinstance(error, BaseException) else None))

    @property
    def stats(self) -> Stats:
        found: Stats = self._call("stats")
        return found

    @property
    def uncalibrated(self) -> tuple[str, ...]:
        found: tuple[str, ...] = self._call("uncalibrated")
        return found

    scan = remote(Link.scan)
    disable = remote(Link.disable)
    stop = remote(Link.stop)
    read_temperatures = remote(Link.read_temperatures)

    def start(self) -> None:
        self._call("start")
        self.position_step = self._call("position_step")

    def enable(self) -> Sample:
        return self._enabled("enable")

    def recover(self) -> Sample:
        return self._enabled("recover")

    def _enabled(self, how: str) -> Sample:
        self._stopped = None
        sample: Sample = self._call(how)
        self._samples.clear()
        self.position_sent, self.torque_sent = self._call("position_sent"), self._call("torque_sent")
        self._in_force = Command.hold(self.position_sent)
        return sample

    def park(self) -> None:
        self.inside(park, lambda text: None)

    def inside(self, function: Callable[..., Any], tell: Tell, *args: Any, **kw: Any) -> Any:
        """As Link.inside. Function, arguments and answer must be picklable; if this process ends, the function's call
        of `tell` raises."""
        self._tell_on = tell
        try:
            return self._call(function, *args, **kw)
        except KeyboardInterrupt:
            with contextlib.suppress(BusFault):  # the function ends at its next `tell`
                self._put(JobSignal.CUT)
            raise

    def cycle(self, command: Command) -> Sample:
        """The next sample with this command in force; a command that is in force already is not sent again."""
        if self._in_force is not None and _same(command, self._in_force):
            return self._next()[2]
        torque = command.torque[None, :].copy()
        setpoints = Setpoints(command.mode.copy(), torque, command.position[None, :].copy(), command.guard)
        (sample,) = self.play(setpoints)
        return sample

    def play(self, setpoints: Setpoints) -> Samples:
        """As Link.play: every row is sent at once, and played whatever this process does meanwhile."""
        if not len(setpoints):
            return
        number = next(numbers)
        for begin in range(0, len(setpoints), CHUNK_ROWS):
            self._put(Play(number, setpoints[begin : begin + CHUNK_ROWS]))
        yield from self._take(number, len(setpoints))
        last = setpoints.command(len(setpoints) - 1)
        self._in_force = Command(last.mode.copy(), last.torque.copy(), last.position.copy(), guard=last.guard)

    def run(self, controller: Controller) -> Samples:
        """As Link.run, in the other process."""
        number = next(numbers)
        self._put(RunController(number, pickle.dumps(controller)))
        yield from self._take(number, sys.maxsize)

    def catch_up(self) -> None:
        """Forget the samples that came while the job did something else; raises what stopped the arm."""
        self._receive()
        self._samples.clear()
        self._raise_stopped()

    def _take(self, number: int, rows: int) -> Samples:
        """Samples of rows 0, 1, … of what was sent as `number`; what is left is cut when the iterator is closed."""
        self._in_force = None
        taken = 0
        try:
            while taken < rows:
                id, row, sample = self._next()
                if id == number and row >= 0:
                    taken = row + 1
                    yield sample
        finally:
            if taken < rows:
                with contextlib.suppress(BusFault):
                    self._put(JobSignal.CUT)

    def _next(self) -> tuple[int, int, Sample]:
        """The next cycle that was not taken yet; raises what stopped the arm, BusFault."""
        end = time.monotonic() + SAMPLE_SECONDS
        while not self._samples:
            self._raise_stopped()
            self._tell()
            self._channel.wait(TELL_INTERVAL)
            self._receive()
            if not self._samples and self._stopped is None and time.monotonic() > end:
                raise BusFault(f"no cycle was made for {SAMPLE_SECONDS:g} s: the process that drives the arm hangs")
        self._tell()
        id, row, content = self._samples.popleft()
        sample, self.torque_sent, self.position_sent = unpack(content)
        return id, row, sample

    def _raise_stopped(self) -> None:
        if self._stopped is not None:
            stopped, self._stopped = self._stopped, None
            self._in_force = None
            raise stopped.error

    def _tell(self) -> None:
        if time.monotonic() - self._told > TELL_INTERVAL:
            self._put(JobSignal.ALIVE)

    def _put(self, message: object) -> None:
        self._told = time.monotonic()
        self._channel.put(message)
        try:
            while not self._channel.flush(0.1):
                self._receive()
        except Closed:
            raise self._gone() from None

    def _receive(self) -> None:
        try:
            messages = self._channel.receive()
        except Closed:
            raise self._gone() from None
        for message in messages:
            match message:
                case LoopAnswer():
                    self._answers[message.id] = message
                case Stopped():
                    self._stopped = message
                case Told():
                    self._heard = time.monotonic()
                    if message.text:
                        self._tell_on(message.text)
                case _:
                    self._samples.append(message)

    def _ask(self, call: Call) -> LoopAnswer:
        self._put(call)
        return self._answer(call.id)

    def _answer(self, number: int) -> LoopAnswer:
        self._heard = time.monotonic()
        while number not in self._answers:
            if time.monotonic() > self._heard + ANSWER_SECONDS:
                raise BusFault(f"the process that drives the arm has not answered for {ANSWER_SECONDS:g} s")
            self._channel.wait(TELL_INTERVAL)
            self._receive()
        return self._answers.pop(number)

    def _gone(self) -> BusFault:
        ended = f"the process that drives the arm has ended (status {self.exit_status})"
        return BusFault(f"{ended}: each drive stops its joint at its own deadline")

    def _end(self, cause: EndCause) -> None:
        with Presses() as presses:
            self.end(cause, end_logger(self.arm.name, presses))


def _same(one: Command, other: Command) -> bool:
    fields = ("mode", "torque", "position")
    return one.guard is other.guard and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name != "mode") for name in fields
    )
