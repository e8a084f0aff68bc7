"""Messages of a program that commands an arm; time is theirs."""

from collections import deque
from collections.abc import Iterator
from typing import Any

from armlink.bus.listening.joint_messages import JointStateMessage


class ProgramMessages:
    lost = 0

    def __init__(self, names: tuple[str, ...], pieces: Iterator[Any]) -> None:
        """`pieces` are times (K,), positions and torques (K, n)."""
        self._names, self._pieces, self._messages = names, pieces, deque[JointStateMessage]()
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def sleep_until(self, instant: float) -> None:
        self._now = max(self._now, instant)

    def take(self) -> list[JointStateMessage]:
        if not self._messages:
            for t, position, torque in zip(*next(self._pieces, ((), (), ())), strict=True):
                self._messages.append(
                    JointStateMessage("driver", t, t, self._names, position.tolist(), (), torque.tolist())
                )
        found = []
        while self._messages and self._messages[0].arrived <= self._now:
            found.append(self._messages.popleft())
        return found

    def absence(self) -> str:
        return ""

    def close(self) -> None: ...
