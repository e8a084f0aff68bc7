"""Runs the bus loop in this thread (`InlineLoop`, lock-step) or in a process of its own (`LoopProcess`)."""

import gc
import itertools
import multiprocessing
import select
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from armlink.errors import ArmlinkError, BadInput, BusFault, Refused
from armlink.link.types import Calibration
from calib.daemon.loop.loop_messages import Alive, LoopOptions, Message, Reply, Request

ANSWER_SECONDS = 10.0
"""A request that the loop has not answered within this time has failed [s]."""
END_SECONDS = 2.0
"""Time for the loop's process to leave the joints safe, before it is killed [s]."""
Ask = Callable[[Request], Reply]

_numbers = itertools.count(1)


class LoopControllers:
    """Object 2100h of every joint through the bus loop; waits for the answer."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask

    def read_calibration(self, joint: int) -> Calibration:
        """Active gain and offset [N·m] of joint j; raises BusFault."""
        return self._call("read", joint=joint)

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Stage, read back and make active; raises BadInput, BusFault."""
        return self._call("write", joint=joint, calibration=calibration, store=store)

    def _call(self, what: Any, **arguments: Any) -> Calibration:
        reply = self._ask(Request(next(_numbers), what, arguments))
        if reply.error is not None:
            raise error_of(reply)
        assert isinstance(reply.value, Calibration)
        return reply.value


def error_of(reply: Reply) -> ArmlinkError:
    """The error that a reply carries."""
    kinds: dict[int, type[ArmlinkError]] = {1: Refused, 2: BadInput}
    return kinds.get(reply.status, BusFault)(reply.error)


class InlineLoop:
    """The loop in this thread: `pump` runs the cycles of a tenth of a second."""

    def __init__(self, options: LoopOptions) -> None:
        from calib.daemon.loop.arm_loop import ArmLoop

        self.loop = ArmLoop(options)
        self.controllers = LoopControllers(self.loop.handle)

    def sweep(self, poses: int, seed: int) -> Reply | None:
        """Ask for a tour of poses."""
        return self.loop.handle(Request(next(_numbers), "sweep", {"poses": poses, "seed": seed}))

    def pump(self) -> list[Message]:
        """Run cycles; returns their messages."""
        return self.loop.run()

    def close(self) -> None:
        """Leave the joints safe."""
        self.loop.close()


class LoopProcess:
    """The loop in a process of its own, so that nothing in the service can delay a cycle."""

    def __init__(self, options: LoopOptions, fork: bool = False) -> None:
        """Start the process; `fork` is faster, but only safe while this process has no other threads."""
        context = multiprocessing.get_context("fork") if fork else multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        inherited = self._ours if fork else None
        self._process: BaseProcess = context.Process(
            target=_child, args=(theirs, options, inherited), name="armlink-bus", daemon=True
        )
        self._process.start()
        theirs.close()
        self._waiting: dict[int, Future[Reply]] = {}
        self._sending = threading.Lock()

    @property
    def pid(self) -> int | None:
        """Process id of the loop."""
        return self._process.pid

    def fileno(self) -> int:
        """For the event loop: readable when there are messages."""
        return self._ours.fileno()

    def sweep(self, poses: int, seed: int) -> Reply | None:
        """Ask for a tour of poses; the reply comes as a message."""
        self._send(Request(next(_numbers), "sweep", {"poses": poses, "seed": seed}))
        return None

    def pump(self) -> list[Message]:
        """All messages waiting; raises EOFError if the process has ended."""
        messages: list[Message] = []
        try:
            while self._ours.poll():
                message = self._ours.recv()
                waiting = self._waiting.pop(message.id, None) if isinstance(message, Reply) else None
                if waiting is None:
                    messages.append(message)
                else:
                    waiting.set_result(message)
        except (OSError, EOFError) as error:
            self._give_up()
            if not messages:
                raise EOFError(f"the bus loop's process has ended: {error}") from None
        return messages

    def close(self) -> None:
        """End the process, which leaves the joints safe; if it does not end it is killed, and the joints time out."""
        self._send(Request(0, "stop"))
        self._process.join(END_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._give_up()
        self._ours.close()

    def ask(self, request: Request) -> Reply:
        """Send a request and wait for its reply."""
        answer: Future[Reply] = Future()
        self._waiting[request.id] = answer
        if not self._send(request):
            return Reply(request.id, error="the bus loop's process has ended", status=BusFault.exit_status)
        try:
            return answer.result(ANSWER_SECONDS)
        except TimeoutError:
            self._waiting.pop(request.id, None)
            return Reply(request.id, error=f"no answer within {ANSWER_SECONDS:g} s", status=BusFault.exit_status)

    def _send(self, request: Request) -> bool:
        try:
            with self._sending:
                self._ours.send(request)
        except (OSError, ValueError):
            return False
        return True

    def _give_up(self) -> None:
        waiting, self._waiting = self._waiting, {}
        for number, answer in waiting.items():
            try:
                answer.set_result(Reply(number, error="the bus loop's process has ended", status=3))
            except InvalidStateError:
                continue


def _child(connection: Connection, options: LoopOptions, inherited: Connection | None) -> None:
    """Main function of the process: cycles until asked to stop, or until the service is gone."""
    if inherited is not None:
        inherited.close()  # the service's end: kept open here, it would hide that the service has ended
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches the whole process group; the service ends this process
    signal.signal(signal.SIGTERM, lambda number, frame: _raise_end())
    from calib.daemon.loop.arm_loop import ArmLoop  # not loaded in the service

    loop = ArmLoop(options)
    gc.collect()
    gc.freeze()
    try:
        while True:
            for message in loop.run() or [Alive()]:
                _send_message(connection, message)
            while connection.poll(loop.wait()):
                request = connection.recv()
                if request.what == "stop":
                    return
                _send_message(connection, loop.handle(request), patience=1.0)
    except (EOFError, OSError, _End):
        return  # the service is gone: leave the joints safe
    finally:
        loop.close()


def _send_message(connection: Connection, message: Message, patience: float = 0.0) -> None:
    """Send, unless the service is so far behind that sending would delay the cycle: then the message is dropped."""
    if select.select([], [connection], [], patience)[1]:
        connection.send(message)


class _End(Exception):
    """SIGTERM."""


def _raise_end() -> None:
    raise _End
