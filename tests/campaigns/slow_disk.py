"""A disk whose fsync takes long, for a process started here; and what that process tells systemd meanwhile."""

import socket
import subprocess
import threading
import time
from itertools import pairwise
from pathlib import Path

SOURCE = Path(__file__).with_name("slow_fsync.c")


class SlowDisk:
    """`environment` is for the process; `seconds` sets how much longer each of its fsyncs takes from now on."""

    def __init__(self, folder: Path) -> None:
        """Compiles the library into `folder`; raises OSError without a C compiler."""
        library, self._control = folder / "slow_fsync.so", folder / "slow_fsync"
        command = ["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE), "-ldl"]
        subprocess.run(command, check=True, capture_output=True)
        self.environment = {"LD_PRELOAD": str(library), "SLOW_FSYNC": str(self._control)}

    def seconds(self, given: float) -> None:
        """From now on [s]."""
        self._control.write_text(str(given))


class SystemdSocket:
    """Stands for systemd: notes when the process says that it lives."""

    def __init__(self, folder: Path, watchdog: float = 10.0) -> None:
        path = str(folder / "notify")
        self.environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": str(round(watchdog * 1e6))}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(path)
        self._signs: list[float] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def longest_gap(self, begun: float, ended: float) -> float:
        """Longest time without a sign of life between two times of the monotonic clock [s]."""
        times = [begun, *(each for each in self._signs if begun < each < ended), ended]
        return max(later - earlier for earlier, later in pairwise(times))

    def _listen(self) -> None:
        while True:
            if b"WATCHDOG=1" in self._socket.recv(4096):
                self._signs.append(time.monotonic())
