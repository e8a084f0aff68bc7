"""The process that owns an arm's bus and keeps its cycle: `python -m armlink.loop.process FD`, started by a RemoteLink.

It makes every cycle on time whatever the job is doing: it plays what the job has sent ahead, and keeps the last command
when there is nothing left. It has a session of its own: what reaches the job from its terminal does not reach it. When
the job ends or is killed it brings the arm to its end (`armlink.link.ends`). When the job falls silent while joints are
under torque control, they are held where they stand; under position control they keep their targets.
"""

import contextlib
import math
import pickle
import socket
import sys
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from armlink.errors import ArmlinkError, BusFault, Refused, Stall
from armlink.link.ends import EndCause
from armlink.link.gate import TORQUE_MODES
from armlink.link.guard import Crossed
from armlink.link.link import Link
from armlink.link.types import Command, Controller, Sample, Setpoints
from armlink.loop.channel import Channel, Closed
from armlink.loop.ending import Ending, telling
from armlink.loop.messages import Alive, Call, Cut, End, LoopAnswer, Open, Play, RunController, Stopped, Told, pack
from armlink.loop.realtime import prepare

IDLE = 0.05
"""Longest wait for the job while the joints are not enabled [s]."""
SWITCH = 5e-4
"""Longest time for which another thread of this process holds up a cycle [s]."""
SILENT = 3.0
"""A job that says nothing for this long while joints are under torque control is gone [s]."""
TALK_EVERY = 7e-3
"""Samples wait for each other for this long [s]: waking the job costs as much as half a cycle. While rows are played,
the job is not heard more often either, and replies are waited for in those cycles alone."""
SIGN_EVERY = 1.0
"""Time between two signs of life [s]."""
ENABLING = ("enable", "recover")


class DriveLoop:
    """The cycles of one link, and what the job asks for between them."""

    def __init__(self, channel: Channel, link: Link) -> None:
        """`link` is open and not started."""
        self._channel, self._link = channel, link
        self._chunks: deque[Setpoints] = deque()
        self._source: Iterator[Sample] | None = None
        self._last: Command | None = None
        self._id, self._row, self._rows = 0, -1, 0
        self._talked = -math.inf
        """When the job was last heard and sent what waits for it [s]."""
        self._busy = False
        """Whether rows are being played, and the job need be neither heard nor told."""
        self._controlled = False
        """Whether a controller is being run."""
        self._end: End | None = None
        """How the job wants the arm to end."""
        self._fault: ArmlinkError = BusFault("the joints are not enabled: call start() and enable() before cycle()")
        """Why the joints are not enabled."""
        self._beside = ThreadPoolExecutor(1)
        self._unpickled: Future[Controller] | None = None
        """A controller that is on its way."""
        self._heard = time.monotonic()
        self._signed = -math.inf
        """When the job was last told that this process makes cycles [s]."""
        link.commander.loop.on_cycle = self._sign_of_life

    def run(self, ending: Ending) -> EndCause:
        """Until the job says how the arm is to end, or SIGTERM is for this process alone; raises Closed where the job
        has gone."""
        while not ending.due:
            if ending.orphaned:
                raise Closed
            if not self._busy:
                for message in self._channel.receive():
                    self._heard = time.monotonic()
                    self._handle(message)
            if self._end is not None:
                return self._end.cause
            if self._link.enabled:
                self._cycle()
            elif self._link.held:
                self._keep()
            else:
                self._channel.flush()
                self._channel.wait(IDLE)
        return EndCause.INTERRUPTED

    def _handle(self, message: object) -> None:
        match message:
            case Call():
                self._call(message)
            case End():
                self._end = message
            case Play() | RunController() if not self._link.enabled:
                self._channel.put(Stopped(self._fault))
            case Play(id, setpoints):
                if id != self._id:
                    self._begin(id)
                self._chunks.append(setpoints)
                self._rows += len(setpoints)
            case RunController(id, controller):
                self._begin(id)
                self._unpickled = self._beside.submit(pickle.loads, controller)
            case Cut() if self._controlled:  # its last torque is right for its last sample alone
                self._hold_here()
            case Cut():
                self._chunks.clear()
                self._source = self._unpickled = None
            case Alive():
                pass

    def _begin(self, id: int) -> None:
        self._chunks.clear()
        self._source, self._id, self._row, self._rows, self._controlled = None, id, -1, 0, False
        self._unpickled = None

    def _call(self, call: Call) -> None:
        link = self._link
        link.tell = tell = lambda text: self._tell(call.id, text)
        try:
            kwargs = dict(call.kwargs)
            if callable(call.what):
                answer = LoopAnswer(call.id, call.what(link, tell, *call.args, **kwargs))
            else:
                found = getattr(link, call.what)
                answer = LoopAnswer(call.id, found(*call.args, **kwargs) if callable(found) else found)
        except ArmlinkError as error:
            answer = LoopAnswer(call.id, error=error)
        except KeyboardInterrupt:
            answer = LoopAnswer(call.id, error=Refused("interrupted"))
        if link.enabled and (callable(call.what) or call.what in ENABLING):
            self._begin(0)
            self._last = link.last
        self._channel.put(answer)
        self._channel.flush()

    def _tell(self, id: int, text: str) -> None:
        """Tell what a function does; raises KeyboardInterrupt in it where the job says so."""
        self._channel.put(Told(id, text))
        self._channel.flush()
        messages = self._channel.receive()
        self._end = next((each for each in messages if isinstance(each, End)), self._end)
        if any(isinstance(each, Cut | End) for each in messages):
            raise KeyboardInterrupt

    def _sign_of_life(self) -> None:
        """Tell the job now and then that cycles are made, whatever call they are made in: it would take silence for a
        hang."""
        now = time.monotonic()
        if now - self._signed >= SIGN_EVERY:
            self._signed = now
            self._channel.put(Told(0, ""))
            with contextlib.suppress(Closed):
                self._channel.flush()

    def _keep(self) -> None:
        """Hold the joints, which were stopped."""
        with contextlib.suppress(BusFault):  # where nothing can be sent the next cycle tries again
            self._link.keep()
        self._channel.flush()

    def _cycle(self) -> None:
        """One cycle: the next row, or the last command once more."""
        now = time.monotonic()
        due = now - self._talked >= TALK_EVERY
        busy = not due and self._row + 2 < self._rows and not self._controlled
        self._busy = self._link.commander.unhurried = busy
        try:
            row, sample = self._next()
        except Crossed as crossed:
            self._hold_here()
            self._channel.put(Stopped(crossed))
        except ArmlinkError as error:
            self._begin(self._id)
            self._fault = error
            self._channel.put(Stopped(error))
        else:
            self._channel.put((self._id, row, pack(sample, *self._link.sent)), True)
            self._mind_silence(now)
            if not due and row + 1 != self._rows:
                return
            self._talked = now
        self._busy = self._link.commander.unhurried = False
        self._channel.flush()

    def _next(self) -> tuple[int, Sample]:
        if self._unpickled is not None and self._unpickled.done():
            self._source, self._controlled = self._link.run(self._unpickled.result()), True
            self._unpickled = None
        while True:
            if self._source is None and self._chunks:
                self._source = self._link.play(self._chunks.popleft())
            if self._source is None:
                assert self._last is not None
                return -1, self._link.cycle(self._last)
            sample = next(self._source, None)
            if sample is not None:
                self._last = self._link.last
                self._row += 1
                return self._row, sample
            self._source = None

    def _hold_here(self) -> None:
        self._chunks.clear()
        self._source, self._controlled, self._unpickled = None, False, None
        self._last = Command.hold(self._link.latest_position)

    def _mind_silence(self, now: float) -> None:
        if self._last is None or now - self._heard < SILENT:
            return
        if np.isin(self._last.mode, TORQUE_MODES).any():
            self._hold_here()
            self._channel.put(Stopped(Stall(f"the job was silent for {SILENT:g} s: the joints hold where they stand")))


def main(number: int) -> None:
    """Serve the job at the other end of socket `number`; the arm comes to its end, however that comes."""
    ending = Ending()
    channel = Channel(socket.socket(fileno=number))
    try:
        (first,) = _first(channel)
        try:
            link = Link.open(first.arm, first.bus)
        except ArmlinkError as error:
            channel.put(LoopAnswer(0, error=error))
            channel.flush(1.0)
            return
        cause = EndCause.FAILED
        try:
            channel.put(LoopAnswer(0, prepare()))
            sys.setswitchinterval(SWITCH)
            cause = DriveLoop(channel, link).run(ending)
        except Closed:
            cause = EndCause.LOST
        finally:
            link.close(cause, telling(channel))
    except Closed:
        return


def _first(channel: Channel) -> list[Open]:
    while True:
        channel.wait(1.0)
        messages = channel.receive()
        if messages:
            return messages


if __name__ == "__main__":
    main(int(sys.argv[1]))
