"""One program drives an arm: names of the operating system that a program holds for each drive, until it ends.

The names are abstract Unix sockets. They belong to the network namespace, as CAN interfaces do, are the same for all
users, and vanish with the program, however that ends; the kernel tells whose they are.
"""

import contextlib
import errno
import socket
import struct
import sys
from collections.abc import Sequence
from pathlib import Path

from armlink.bus.bus_group import BusGroup
from armlink.bus.can_bus import CanBus
from armlink.errors import BusFault

_UCRED = struct.Struct("3i")
_held: dict[str, tuple[socket.socket, int]] = {}
"""Name → its socket and how often this process holds it."""


class ArmHold:
    """Holds the drives of an arm on its bus until it is released; a process may hold the same ones several times."""

    def __init__(self, bus: CanBus, addresses: Sequence[tuple[str, str]]) -> None:
        """Take them: bus, by its name in the arm file, and id of each drive.

        Raises BusFault, with who has them, where another program drives one of them.
        A bus inside this process, which has a clock of its own, is nobody else's and is not held.
        """
        self._names: list[str] = []
        if bus.clock is not None or not sys.platform.startswith("linux"):
            return
        try:
            for name, address in addresses:
                on = bus.member(name) if isinstance(bus, BusGroup) else bus
                self._take(on.channel_info, address)
        except BaseException:
            self.release()
            raise

    def _take(self, bus: str, address: str) -> None:
        name = f"\0armlink/{bus}/{address}"[:100]
        held, count = _held.get(name, (None, 0))
        if held is None:
            held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                held.bind(name)
                held.listen(1)
            except OSError as error:
                held.close()
                if error.errno != errno.EADDRINUSE:
                    raise BusFault(
                        f"{bus}: {address} cannot be reserved for this program ({error.strerror}), so another "
                        "program might command the arm at the same time"
                    ) from None
                raise BusFault(
                    f"{bus}: {address} is driven by {_holder(name)}: stop that program, since only one "
                    "program may command an arm"
                ) from None
        _held[name] = held, count + 1
        self._names.append(name)

    def release(self) -> None:
        """Let go; another program may then drive the arm."""
        names, self._names = self._names, []
        for name in names:
            held, count = _held.pop(name)
            if count > 1:
                _held[name] = held, count - 1
            else:
                held.close()


def _holder(name: str) -> str:
    """Who holds a name, in words: program, process and user."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        probe.connect(name)
        pid, uid, _ = _UCRED.unpack(probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
        return f"{program_of(pid)} (process {pid}, user {uid})"
    return "another program"


def program_of(pid: int) -> str:
    """Command line of a process, cut short; "another program" where it cannot be read."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "another program"
    text = " ".join(word.rpartition("/")[2] if number < 2 else word for number, word in enumerate(words) if word)
    return " ".join(text.split())[:80] or "another program"
