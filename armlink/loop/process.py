"""The process that owns an arm's bus and keeps its cycle: `python -m armlink.loop.process FD` (`CycleProcess`).

It makes every cycle on time whatever the job is doing: it plays what the job has sent ahead, and keeps the last command
when there is nothing left. It has a session of its own: what reaches the job from its terminal does not reach it. When
the job ends or is killed it brings the arm to its end (`armlink.link.ends`). When the job falls silent while joints are
under torque control, they are held where they stand; under position control they keep their targets.

A command opens the arm once (`DriveLoop`); for the daemon the process opens the bus again after every fault, and may
listen in place of driving (`KeptLoop`).
"""

import contextlib
import math
import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from armlink.bus.arm_hold import ArmHold
from armlink.bus.can_bus import CanBus
from armlink.bus.listening.joint_messages import silence_of
from armlink.bus.open import open_link_bus
from armlink.channel import Channel, Closed, channel_of
from armlink.errors import ArmlinkError, BusFault, Refused, Stall
from armlink.link.bus_load import overload
from armlink.link.ends import EndCause, cause_of
from armlink.link.gate import TORQUE_MODES
from armlink.link.link import Link
from armlink.link.listener import CLOCK_RESOLUTION, Listener
from armlink.link.reading_bounds import Crossed
from armlink.link.types import Command, Controller, Sample, Setpoints
from armlink.loop.ending import Ending, job_teller
from armlink.loop.messages import (
    BATCH_SECONDS,
    Call,
    Down,
    End,
    Health,
    JobSignal,
    LoopAnswer,
    Open,
    Play,
    Progress,
    RunController,
    Stopped,
    Told,
    Up,
    pack,
)
from armlink.loop.open import is_in_process
from armlink.loop.realtime import prepare

IDLE_SECONDS = 0.05
"""Longest wait for the job while the joints are not enabled [s]."""
SWITCH_INTERVAL = 5e-4
"""Longest time for which another thread of this process holds up a cycle [s]."""
SILENT_SECONDS = 3.0
"""A job that says nothing for this long while joints are under torque control is gone [s]."""
TALK_INTERVAL = 7e-3
"""Samples wait for each other for this long [s]: waking the job costs as much as half a cycle. While rows are played,
the job is not heard more often either, and replies are waited for in those cycles alone."""
SIGN_INTERVAL = 1.0
"""Time between two signs of life [s]."""
RETRY_SECONDS = 1.0
"""Time between two attempts to open the bus of a kept arm [s]."""
UNREAD_SECONDS = 10.0
"""Samples of a kept arm that wait for a busy daemon; older ones are dropped [s]."""
SYNC_SECONDS = 0.5
"""A bus without SYNC for this time is reported while listening [s]."""
ENABLING = ("enable", "recover")


class DriveLoop:
    """The cycles of one link, and what the job asks for between them."""

    talk_every = TALK_INTERVAL

    def __init__(self, channel: Channel, arm: Link | Listener | None) -> None:
        """A link is open and not started."""
        self._channel, self.arm = channel, arm
        self._aside: list[object] = []
        """Messages of the job that came while the arm was brought to an end."""
        self._chunks: deque[Setpoints] = deque()
        self._source: Iterator[Sample] | None = None
        self._last: Command | None = None
        self._id, self._row, self._rows = 0, -1, 0
        self._talked = -math.inf
        """When the job was last heard and sent what waits for it [s]."""
        self._busy = False
        """Whether rows are being played, and the job need be neither heard nor told."""
        self._controller: Controller | None = None
        self._end: End | None = None
        """How the job wants the arm to end."""
        self._fault: ArmlinkError = BusFault("the joints are not enabled: call start() and enable() before cycle()")
        """Why the joints are not enabled."""
        self._beside = ThreadPoolExecutor(1)
        self._unpickled: Future[Controller] | None = None
        self._heard = time.monotonic()
        self._signed = -math.inf
        """When the job was last told that this process makes cycles [s]."""
        if isinstance(arm, Link):
            arm.commander.loop.on_cycle = self._sign_of_life

    @property
    def _link(self) -> Link:
        assert isinstance(self.arm, Link)
        return self.arm

    @property
    def _enabled(self) -> bool:
        return isinstance(self.arm, Link) and self.arm.enabled

    def run(self, ending: Ending) -> EndCause:
        """Until the job says how the arm is to end, or SIGTERM is for this process alone; raises Closed where the job
        has gone."""
        while not ending.due:
            if ending.orphaned:
                raise Closed
            if not self._busy:
                self.hear()
            if self._end is not None:
                return self._end.cause
            self.turn()
        return EndCause.INTERRUPTED

    def hear(self) -> None:
        aside, self._aside = self._aside, []
        for message in (*aside, *self._channel.receive()):
            self._heard = time.monotonic()
            self._handle(message)

    def turn(self) -> None:
        """A cycle; a wait for the job while there are none."""
        if self._link.enabled:
            self._cycle()
        elif self._link.held:
            self._keep()
        else:
            self._channel.flush()
            self._channel.wait(IDLE_SECONDS)

    def close(self, cause: EndCause) -> None:
        """Bring the arm to its end (`armlink.link.ends`), telling the job how far that is, and close the bus."""
        self._link.close(cause, job_teller(self._channel, self._aside.append))

    def _handle(self, message: object) -> None:
        match message:
            case Call():
                self._channel.put(self._answer(message))
                self._channel.flush()
            case End():
                self._end = message
            case Play() | RunController() if not self._enabled:
                self._channel.put(Stopped(self._fault))
            case Play(id, setpoints):
                if id != self._id:
                    self._begin(id)
                self._chunks.append(setpoints)
                self._rows += len(setpoints)
            case RunController(id, controller):
                self._begin(id)
                self._unpickled = self._beside.submit(pickle.loads, controller)
            case JobSignal.CUT if self._controller is not None:  # its last torque is right for its last sample alone
                self._hold_here()
            case JobSignal.CUT:
                self._cut()

    def _begin(self, id: int) -> None:
        self._cut()
        self._id, self._row, self._rows = id, -1, 0

    def _cut(self) -> None:
        self._chunks.clear()
        self._source = self._controller = self._unpickled = None

    def _answer(self, call: Call) -> LoopAnswer:
        link, tell = self.arm, lambda text: self._tell(call.id, text)
        if isinstance(link, Link):
            link.tell = tell
        try:
            if callable(call.what):
                answer = LoopAnswer(call.id, call.what(link, tell, *call.args, **call.kwargs))
            else:
                found = getattr(link, call.what)
                answer = LoopAnswer(call.id, found(*call.args, **call.kwargs) if callable(found) else found)
        except ArmlinkError as error:
            answer = LoopAnswer(call.id, error=error)
        except KeyboardInterrupt:
            answer = LoopAnswer(call.id, error=Refused("interrupted"))
        if self._enabled and (callable(call.what) or call.what in ENABLING):
            self._begin(0)
            self._last = self._link.last
        return answer

    def _tell(self, id: int, text: str) -> None:
        """Tell what a function does; raises KeyboardInterrupt in it where the job says so."""
        self._channel.put(Told(id, text))
        self._channel.flush()
        messages = self._channel.receive()
        self._end = next((each for each in messages if isinstance(each, End)), self._end)
        if any(each is JobSignal.CUT or isinstance(each, End) for each in messages):
            raise KeyboardInterrupt

    def _sign_of_life(self) -> None:
        """Tell the job now and then that cycles are made, whatever call they are made in: it would take silence for a
        hang."""
        now = time.monotonic()
        if now - self._signed >= SIGN_INTERVAL:
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
        now, link = time.monotonic(), self._link
        due = now - self._talked >= self.talk_every
        busy = not due and self._row + 2 < self._rows and self._controller is None
        self._busy = link.commander.unhurried = busy
        try:
            row, sample = self._next()
        except Crossed as crossed:
            self._hold_here()
            self._channel.put(Stopped(crossed))
        except ArmlinkError as error:
            self._stopped(error)
        else:
            self._channel.put((self._id, row, pack(sample, *link.sent)), True)
            self._mind_silence(now)
            if not due and not 0 <= row == self._rows - 1:
                return
            self._talked = now
        self._busy = link.commander.unhurried = False
        self._talk()

    def _stopped(self, error: ArmlinkError) -> None:
        self._begin(self._id)
        self._fault = error
        self._channel.put(Stopped(error))

    def _talk(self) -> None:
        self._channel.flush()

    def _next(self) -> tuple[int, Sample]:
        if self._unpickled is not None and self._unpickled.done():
            self._controller, self._unpickled = self._unpickled.result(), None
            self._source = self._link.run(self._controller)
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
        self._cut()
        self._last = Command.hold(self._link.latest_position)

    def _mind_silence(self, now: float) -> None:
        if self._last is None or now - self._heard < SILENT_SECONDS:
            return
        if np.isin(self._last.mode, TORQUE_MODES).any():
            self._hold_here()
            why = f"the job was silent for {SILENT_SECONDS:g} s: the joints hold where they stand"
            self._channel.put(Stopped(Stall(why)))


class KeptLoop(DriveLoop):
    """The same for a daemon: the arm is opened, started and enabled, or listened to, and that again after each fault.

    A fault of bus or joint is a message, never an exception.
    """

    talk_every = BATCH_SECONDS

    def __init__(
        self, channel: Channel, opening: Open, open_bus: Callable[[], CanBus] | None = None, pace: bool = True
    ) -> None:
        """Tests have their own `open_bus`; without `pace` nobody waits for the machine's clock."""
        super().__init__(channel, None)
        self._opening, self._pace = opening, pace
        self._open_bus = open_bus or (lambda: open_link_bus(opening.bus, opening.arm.require_link()))
        self._hold: ArmHold | None = None
        self._fault = BusFault("the bus is not open")
        self._silent = False
        """Whether a bus without SYNC was reported."""
        self._synced = 0.0
        """When a SYNC was last heard, by the listener's clock [s]."""
        self._progress: tuple[int, int] | None = None
        self._real_start: tuple[float, float] | None = None

    def turn(self) -> None:
        """A cycle, the listening of a tenth of a second, or an attempt to open the bus and a wait for the next."""
        try:
            if self.arm is None:
                self._open()
            elif isinstance(self.arm, Listener):
                self._listen(self.arm)
            else:
                self._cycle()
        except ArmlinkError as error:
            self._stopped(error)
            self._talk()
        if self.arm is not None:
            self._keep_pace(self.arm)
        elif self._pace:
            self._channel.wait(RETRY_SECONDS)

    def close(self, cause: EndCause) -> None:
        """As DriveLoop.close; a bus that has gone already is left to the drives' own deadlines."""
        arm, self.arm = self.arm, None
        self._begin(0)
        with contextlib.suppress(ArmlinkError, OSError):
            if isinstance(arm, Link):
                arm.close(cause, job_teller(self._channel, self._aside.append))
            elif arm is not None:
                arm.__exit__(None, None, None)

    def _open(self) -> None:
        arm, bus = self._opening.arm, self._open_bus()
        if self._opening.listen_only:
            self.arm = listener = Listener(arm, bus)
            self._synced = listener.clock.now()
            self._up(Up(None, listener.uncalibrated))
            return
        self.arm = link = Link(arm, bus, overloaded=overload(arm, self._opening.bus), spec=self._opening.bus)
        link.commander.loop.on_cycle = self._sign_of_life
        self._hold = self._hold or ArmHold(bus, link.addresses)  # for good: through a passing fault too
        link.start()
        held = tuple(link.read_calibration(joint) for joint in range(link.n))  # before requests have to wait for cycles
        sample = link.enable()
        self._last, self._real_start = link.last, None
        self._up(Up(held, link.uncalibrated, link.clock.now() - sample.t))

    def _up(self, up: Up) -> None:
        self._silent = False
        self._channel.put(up)
        self._channel.flush()

    def _stopped(self, error: ArmlinkError) -> None:
        self._fault = error
        self.close(cause_of(error))
        self._channel.put(Down(str(error)))

    def _answer(self, call: Call) -> LoopAnswer:
        if self.arm is None:
            return LoopAnswer(call.id, error=BusFault(str(self._fault)))
        answer = super()._answer(call)
        if isinstance(answer.error, BusFault):
            self._fault = answer.error
            self.close(cause_of(answer.error))
        return answer

    def _talk(self) -> None:
        if self.arm is None:
            self._channel.put(Told(0, ""))
        else:
            events = tuple(self.arm.emergencies) if isinstance(self.arm, Listener) else ()
            self._channel.put(Health(self.arm.stats, events, self.arm.temperatures), True)
        progress: tuple[int, int] | None = getattr(self._controller, "progress", None)
        if progress != self._progress:
            self._progress = progress
            if progress is not None:
                self._channel.put(Progress(*progress))
        self._channel.flush()

    def _listen(self, listener: Listener) -> None:
        end, heard = listener.clock.now() + BATCH_SECONDS, False
        while (remaining := end - listener.clock.now()) > CLOCK_RESOLUTION:
            sample = listener.next(remaining)
            while sample is not None:
                heard = True
                sent = listener.torque_sent, listener.position_sent
                self._channel.put((0, -1, pack(sample, *sent)), True)
                sample = listener.next(0.0)
            self._keep_pace(listener)
        self._mind_sync(listener, heard)
        self._talk()
        listener.emergencies.clear()

    def _mind_sync(self, listener: Listener, heard: bool) -> None:
        """Report once that no SYNC arrives, and once that it is back."""
        now = listener.clock.now()
        if heard:
            self._synced = now
            if self._silent:
                self._up(Up(None, listener.uncalibrated))
        elif now - self._synced > SYNC_SECONDS and not self._silent:
            self._silent = True
            name = listener.bus.channel_info
            why = silence_of(listener.bus, f"no SYNC on {name}: is the program that commands the arm running?")
            self._channel.put(Down(why if name in why else f"{name}: {why}"))

    def _keep_pace(self, arm: Link | Listener) -> None:
        """Run an in-process simulated arm in real time: wait for the machine's clock."""
        if not self._pace or arm.bus.clock is None:
            return
        now, real = arm.clock.now(), time.monotonic()
        if self._real_start is None or real - self._real_start[1] - (now - self._real_start[0]) > 1.0:
            self._real_start = (now, real)  # the machine is too slow: do not catch up
        ahead = (now - self._real_start[0]) - (real - self._real_start[1])
        if ahead > 0:
            time.sleep(ahead)


def main(number: int) -> None:
    """Serve the job at the other end of socket `number`; the arm comes to its end, however that comes."""
    ending = Ending()
    channel = channel_of(number)
    with contextlib.suppress(Closed):
        opening: Open = channel.first()
        if opening.log is not None:
            opening.log()
        try:
            loop = _loop(channel, opening)
        except ArmlinkError as error:
            channel.put(LoopAnswer(0, error=error))
            channel.flush(1.0)
            return
        cause = EndCause.FAILED
        try:
            simulated = opening.kept and is_in_process(opening.arm, opening.bus)  # it leaves its host the first place
            channel.put(LoopAnswer(0, None if simulated else prepare()))
            sys.setswitchinterval(SWITCH_INTERVAL)
            cause = loop.run(ending)
        except Closed:
            cause = EndCause.LOST
        finally:
            loop.close(cause)


def _loop(channel: Channel, opening: Open) -> DriveLoop:
    if not opening.kept:
        return DriveLoop(channel, Link.open(opening.arm, opening.bus))
    channel.most = round(UNREAD_SECONDS * opening.arm.require_link().rate)
    return KeptLoop(channel, opening)


if __name__ == "__main__":
    main(int(sys.argv[1]))
