"""An arm that a process keeps open for a daemon: batches of samples, state of the bus, requests from any thread."""

import pickle
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, InvalidStateError
from typing import Any

from armlink.arm_file import ArmFile
from armlink.channel import Closed
from armlink.errors import BusFault
from armlink.link.ends import EndCause
from armlink.link.types import Controller, Tell
from armlink.loop.cycle_process import CycleProcess, numbers
from armlink.loop.ending import HANG_SECONDS
from armlink.loop.messages import (
    Batch,
    Call,
    Down,
    Health,
    LoopAnswer,
    Open,
    Progress,
    RunController,
    Stopped,
    Told,
    Up,
)

ENDED = "the bus loop's process has ended"
KeptMessage = Told | Batch | Up | Down | LoopAnswer | Progress | Stopped


class BatchMaker:
    """Batches from the messages of a kept loop."""

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self._begun = 0.0

    def take(self, message: Any) -> KeptMessage | None:
        """A message as the daemon gets it; None for a sample, which comes with its batch."""
        match message:
            case tuple():
                self._packed.append(message[2])
                return None
            case Health():
                packed, self._packed = self._packed, []
                return Batch.of(packed, self._begun, message) if packed else Told(0, "")
            case Up() if message.begun != self._begun:  # samples of before a fault are of another time
                self._packed, self._begun = [], message.begun
        made: KeptMessage = message
        return made


class KeptArm(CycleProcess):
    """Nothing in the daemon can delay a cycle. `pump`, `move` and `close` are for one thread, `ask` for any."""

    def __init__(
        self,
        arm: ArmFile,
        bus: str | None = None,
        listen_only: bool = False,
        inherits: Sequence[int] = (),
        log: Callable[[], None] | None = None,
    ) -> None:
        """Start the process, which opens the bus as soon as that is there; `log` is called in it first."""
        self._waiting: dict[int, Future[LoopAnswer]] = {}
        self._sending, self._batches = threading.Lock(), BatchMaker()
        super().__init__(Open(arm, bus, kept=True, listen_only=listen_only, log=log), inherits)

    def fileno(self) -> int:
        """For the event loop: readable when there are messages."""
        return self._channel.fileno()

    def move(self, controller: Controller) -> None:
        """Run a controller from now on; Stopped says where that is not possible."""
        self._send(RunController(next(numbers), pickle.dumps(controller)))

    def pump(self) -> list[KeptMessage]:
        """All messages waiting; raises EOFError if the process has ended."""
        try:
            received = self._channel.receive()
        except Closed:
            self._give_up()
            raise EOFError(ENDED) from None
        messages: list[KeptMessage] = []
        for message in received:
            waiting = self._waiting.pop(message.id, None) if isinstance(message, LoopAnswer) else None
            if waiting is not None:
                waiting.set_result(message)
            elif (made := self._batches.take(message)) is not None:
                messages.append(made)
        return messages

    def ask(self, call: Call) -> LoopAnswer:
        answer: Future[LoopAnswer] = Future()
        self._waiting[call.id] = answer
        if not self._send(call):
            return LoopAnswer(call.id, error=BusFault(ENDED))
        try:
            return answer.result(HANG_SECONDS)
        except TimeoutError:
            self._waiting.pop(call.id, None)
            return LoopAnswer(call.id, error=BusFault(f"no answer from the bus loop within {HANG_SECONDS:g} s"))

    def close(self, cause: EndCause = EndCause.DONE, tell: Tell = lambda text: None) -> None:
        with self._sending:
            self.end(cause, tell)
        self._give_up()

    def _send(self, message: object) -> bool:
        try:
            with self._sending:
                self._channel.put(message)
                return self._channel.flush(HANG_SECONDS)
        except (Closed, ValueError):
            return False

    def _give_up(self) -> None:
        waiting, self._waiting = self._waiting, {}
        for number, answer in waiting.items():
            try:
                answer.set_result(LoopAnswer(number, error=BusFault(ENDED)))
            except InvalidStateError:
                continue
