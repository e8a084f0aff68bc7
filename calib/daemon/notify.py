"""Telling systemd how the service is (sd_notify): ready, reloading, stopping, alive, one line of status."""

import os
import socket


class Notifier:
    """Sends to the socket of NOTIFY_SOCKET; does nothing where systemd did not give one."""

    def __init__(self, address: str | None = None) -> None:
        """`address` is by default that of the environment; a leading @ stands for an abstract socket."""
        given = os.environ.get("NOTIFY_SOCKET", "") if address is None else address
        self._address = "\0" + given[1:] if given.startswith("@") else given

    def __call__(self, *lines: str) -> None:
        """Send assignments such as READY=1; a socket that is gone is no reason to stop."""
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            return


def watchdog_seconds() -> float | None:
    """How often systemd wants to hear WATCHDOG=1 at least [s]; None where it does not ask this process."""
    given, of = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not given.isdigit() or int(given) == 0 or (of and of != str(os.getpid())):
        return None
    return int(given) * 1e-6
