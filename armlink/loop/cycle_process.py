"""The process that makes an arm's cycles (`armlink.loop.process`), as whoever has started it sees it."""

import contextlib
import itertools
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from armlink.channel import Closed, start_process
from armlink.link.ends import EndCause
from armlink.link.types import Controllers, Tell
from armlink.loop.ending import HANG_SECONDS, see_out
from armlink.loop.messages import Call, LoopAnswer, Open

numbers = itertools.count(1)
"""Ids of what is asked of a process."""
R = TypeVar("R")
P = ParamSpec("P")


class CycleProcess:
    """A process that runs, the channel to it, and its end."""

    def __init__(self, opening: Open, inherits: Sequence[int] = ()) -> None:
        """Start it; what comes of `opening` it answers. It holds the descriptors that it `inherits` until it ends."""
        self._process, self._channel = start_process(("-m", "armlink.loop.process"), inherits)
        self._channel.put(opening)
        with contextlib.suppress(Closed):  # whoever receives next learns that
            self._channel.flush(HANG_SECONDS)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def exit_status(self) -> int | None:
        """How the process ended; None while it runs."""
        return self._process.poll()

    def kill(self) -> None:
        """End a process that hangs: the drives' own deadlines decide. `end` comes after it."""
        self._process.kill()

    def end(self, cause: EndCause, tell: Tell) -> None:
        """Have it bring the arm to its end, and wait for it; one that hangs is killed.

        `tell` is told what it does, and may raise Dropped.
        """
        if not see_out(self._channel, lambda: self._process.poll() is None, cause, tell):
            self._process.kill()
        self._process.wait()


def remote(method: Callable[Concatenate[Any, P], R]) -> "Callable[Concatenate[RemoteControllers, P], R]":
    """A method of the link's protocol, as a request to the process."""

    @wraps(method)
    def ask(self: "RemoteControllers", /, *args: P.args, **kwargs: P.kwargs) -> R:
        return cast(R, self._call(method.__name__, *args, **kwargs))

    return ask


class RemoteControllers:
    """`Controllers` through the process; waits for the answers."""

    def __init__(self, ask: Callable[[Call], LoopAnswer]) -> None:
        self._ask = ask

    def _call(self, what: str | Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        return self._ask(Call(next(numbers), what, args, kwargs)).result()

    read_calibration = remote(Controllers.read_calibration)
    drive_serial = remote(Controllers.drive_serial)
    write_calibration = remote(Controllers.write_calibration)
