"""Notifies systemd (sd_notify): ready, reloading, stopping, alive, one line of status."""

import os
import socket


class Notifier:
    """Sends to the socket of NOTIFY_SOCKET; does nothing if there is none."""

    def __init__(self, address: str | None = None) -> None:
        """`address` defaults to the environment's; a leading @ means an abstract socket."""
        given = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + given[1:] if given.startswith("@") else given
        self._waiting: dict[str, str] = {}
        """Messages that the socket has not taken, in order, by the name of their first assignment."""

    def __call__(self, *lines: str) -> None:
        """Send assignments such as READY=1; what the socket does not take now is sent by a later `flush`, in order.

        A message that begins with the same name replaces one that still waits.
        """
        name = lines[0].partition("=")[0]
        self._waiting.pop(name, None)
        self._waiting[name] = "\n".join(lines)
        self.flush()

    def flush(self) -> None:
        if not self._address:
            self._waiting.clear()
        if not self._waiting:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
                for name, message in list(self._waiting.items()):
                    sender.sendto(message.encode(), self._address)
                    del self._waiting[name]
        except OSError:
            return


def watchdog_seconds() -> float | None:
    """Longest time between two WATCHDOG=1 that systemd accepts [s]; None if it has no watchdog on this process."""
    given, of = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not given.isdigit() or int(given) == 0 or (of and of != str(os.getpid())):
        return None
    return int(given) * 1e-6
