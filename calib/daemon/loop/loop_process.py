"""Runs the bus loop in a process of its own."""

import itertools
import multiprocessing
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from multiprocessing.process import BaseProcess
from typing import TypeVar

from armlink.errors import BusFault
from armlink.link.ends import EndCause
from armlink.link.types import Calibration, DriveSerial, Tell
from armlink.loop.channel import Channel, Closed
from armlink.loop.ending import Ending, see_out, telling
from armlink.loop.messages import Alive, Call, End, LoopAnswer
from armlink.loop.open import is_in_process
from armlink.loop.realtime import prepare
from calib.daemon.loop.loop_messages import Batch, LoopOptions, Message, Started

ANSWER_SECONDS = 10.0
"""A call that the loop has not answered within this time has failed [s]."""
BATCHES = 100
"""Batches that wait for a busy service: 10 s; older ones are dropped."""
ENDED = "the bus loop's process has ended"
Ask = Callable[[Call], LoopAnswer]
T = TypeVar("T")

_numbers = itertools.count(1)


def _tour(poses: int, seed: int) -> Call:
    return Call(next(_numbers), "sweep", (poses, seed))


class LoopControllers:
    """Calibrations of every joint through the bus loop; waits for the answer."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask

    def read_calibration(self, joint: int) -> Calibration:
        """Active gain and offset [N·m] of joint j; raises BusFault."""
        return self._call("read_calibration", Calibration, joint)

    def drive_serial(self, joint: int) -> DriveSerial:
        """Serial number of the drive of joint j; raises BusFault."""
        return self._call("drive_serial", DriveSerial, joint)

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Stage, read back and make active; raises BadInput, BusFault."""
        return self._call("write_calibration", Calibration, joint, calibration, store)

    def _call(self, what: str, kind: type[T], *args: object) -> T:
        answer = self._ask(Call(next(_numbers), what, args))
        if answer.error is not None:
            raise answer.error
        assert isinstance(answer.value, kind)
        return answer.value


class LoopProcess:
    """The loop in a process of its own, so that nothing in the service can delay a cycle."""

    def __init__(self, options: LoopOptions, fork: bool = False) -> None:
        """Start the process; `fork` is faster, but only safe while this process has no other threads."""
        context = multiprocessing.get_context("fork") if fork else multiprocessing.get_context("spawn")
        ours, theirs = socket.socketpair()
        inherited = ours if fork else None
        self._process: BaseProcess = context.Process(
            target=_child, args=(theirs, options, inherited), name="armlink-bus", daemon=True
        )
        self._process.start()
        theirs.close()
        self._channel = Channel(ours)
        self._waiting: dict[int, Future[LoopAnswer]] = {}
        self._sending = threading.Lock()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def fileno(self) -> int:
        """For the event loop: readable when there are messages."""
        return self._channel.fileno()

    def sweep(self, poses: int, seed: int) -> LoopAnswer | None:
        """Ask for a tour of poses; the answer comes as a message."""
        self._send(_tour(poses, seed))
        return None

    def pump(self) -> list[Message]:
        """All messages waiting; raises EOFError if the process has ended."""
        messages: list[Message] = []
        try:
            received = self._channel.receive()
        except Closed:
            self._give_up()
            raise EOFError(ENDED) from None
        for message in received:
            waiting = self._waiting.pop(message.id, None) if isinstance(message, LoopAnswer) else None
            if waiting is None:
                messages.append(message)
            else:
                waiting.set_result(message)
        return messages

    def close(self, cause: EndCause = EndCause.DONE, tell: Tell = lambda text: None) -> None:
        """End the process, which brings the arm to its end, and wait for it; one that hangs is killed.

        `tell` is told what it does, and may raise Dropped.
        """
        with self._sending:
            if not see_out(self._channel, self._process.is_alive, cause, tell):
                self._process.kill()
        self._process.join()
        self._give_up()

    def kill(self) -> None:
        """End a process that hangs: the drives' own deadlines decide. `close` comes after it."""
        self._process.kill()

    def ask(self, call: Call) -> LoopAnswer:
        answer: Future[LoopAnswer] = Future()
        self._waiting[call.id] = answer
        if not self._send(call):
            return LoopAnswer(call.id, error=BusFault(ENDED))
        try:
            return answer.result(ANSWER_SECONDS)
        except TimeoutError:
            self._waiting.pop(call.id, None)
            return LoopAnswer(
                call.id, error=BusFault(f"the process of the bus loop has not answered for {ANSWER_SECONDS:g} s")
            )

    def _send(self, call: Call) -> bool:
        try:
            with self._sending:
                self._channel.put(call)
                return self._channel.flush(ANSWER_SECONDS)
        except (Closed, ValueError):
            return False

    def _give_up(self) -> None:
        waiting, self._waiting = self._waiting, {}
        for number, answer in waiting.items():
            try:
                answer.set_result(LoopAnswer(number, error=BusFault(ENDED)))
            except InvalidStateError:
                continue


def _child(end: socket.socket, options: LoopOptions, inherited: socket.socket | None) -> None:
    """Main function of the process: cycles until the service has closed its end, or is gone."""
    if inherited is not None:
        inherited.close()  # the service's end: kept open here, it would hide that the service has ended
    ending, channel = Ending(), Channel(end, BATCHES)
    from calib.daemon.loop.arm_loop import ArmLoop  # not loaded in the service

    waiting: list[Call | End] = []  # said while the arm was brought to an end
    cause, loop = EndCause.FAILED, ArmLoop(options, telling(channel, waiting.append))
    if options.open_bus is None and not is_in_process(options.arm, options.bus):
        channel.put(Started(prepare()))
    try:
        while not ending.due:
            if ending.orphaned:
                raise Closed
            for message in loop.run() or [Alive()]:
                channel.put(message, isinstance(message, Batch))
            channel.flush()
            if loop.wait():
                channel.wait(loop.wait())
            messages = [*waiting, *channel.receive()]
            waiting.clear()
            for message in messages:
                if isinstance(message, End):
                    cause = message.cause
                    return
                channel.put(loop.handle(message))
            channel.flush()
        cause = EndCause.INTERRUPTED
    except Closed:
        cause = EndCause.LOST
    finally:
        loop.close(cause)
