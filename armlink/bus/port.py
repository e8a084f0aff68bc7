"""Frames and ports: the interface to send and receive on a CAN bus."""

import errno
import logging
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from armlink.errors import ArmlinkError, BusFault

Frame = tuple[int, bytes]
"""Identifier, with flags as in SocketCAN, and data. A remote frame has as much data (zeros) as it asks for."""
Stamped = tuple[float, int, bytes]
"""Time of reception by the machine's monotonic clock [s], identifier and data."""

EXTENDED = 0x80000000
"""Flag in the identifier of a frame with 29 bits of identifier, as in SocketCAN."""
REMOTE = 0x40000000
"""Flag in the identifier of a remote frame."""
ERROR = 0x20000000
"""Flag in the identifier of an error frame, as in SocketCAN."""

BUS_SHIFT = 34
"""Where there are several buses, identifiers carry the number of theirs from this bit on."""


CLASSICAL = 1 << 33
"""Flag of a frame that leaves as classical CAN on a port that sends CAN FD; a frame that came never has it."""


class InterfaceDown(BusFault):
    """The interface is down; it may come up again."""


class Port(Protocol):
    """Frames with their flags; error frames are counted."""

    @property
    def errors(self) -> int: ...

    @property
    def dropped(self) -> int:
        """Frames lost because they were not read in time, if the interface reports them."""

    @property
    def send(self) -> Callable[[int, bytes], None]:
        """Sends one frame; raises BusFault if the interface cannot take it."""

    @property
    def receive(self) -> Callable[[float], Frame | None]:
        """The next frame, or None after a timeout [s] (0: only frames that are there already)."""


@runtime_checkable
class Selectable(Protocol):
    def fileno(self) -> int: ...


@runtime_checkable
class StampedPort(Protocol):
    """A port that collects frames with timestamps, so that its reader may sleep for several cycles."""

    def wait(self, timeout: float) -> None:
        """Return when a frame is there, or after `timeout` seconds."""

    def take_all(self) -> list[Stamped]:
        """All frames that are there, in the order of their timestamps; raises BusFault."""


logging.getLogger("can").addHandler(logging.NullHandler())  # else what it logs goes to standard error, unasked


def interface_fault(error: Exception, name: str, doing: str) -> ArmlinkError:
    """The exception for an error of an interface while `doing` something on the bus `name`; our own errors stay."""
    if isinstance(error, ArmlinkError):
        return error
    numbers = {getattr(error, "error_code", None), getattr(error, "errno", None)}
    down = errno.ENETDOWN in numbers
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if isinstance(error, NameError | AttributeError | ImportError):  # its library is missed this late
        reason = f"{reason}: is the driver of the interface installed?"
    if errno.EAFNOSUPPORT in numbers:
        reason = f"{reason}: this kernel has no SocketCAN: load its module with `sudo modprobe can`"
    return (InterfaceDown if down else BusFault)(f"bus {name}: cannot {doing}: {reason}")
