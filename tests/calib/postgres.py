"""A PostgreSQL server of its own for a test session: Debian's package, on a loopback port, in a temporary folder."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

DEBIAN = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))


class NoServer(RuntimeError):
    """There can be no server here; says why."""


def programs() -> Path:
    """Folder of initdb and pg_ctl; raises NoServer where PostgreSQL is not installed."""
    on_path = shutil.which("pg_ctl")
    folders = [Path(on_path).resolve().parent] if on_path else []
    for folder in [*folders, *reversed(DEBIAN)]:
        if (folder / "initdb").exists() and (folder / "pg_ctl").exists():
            return folder
    raise NoServer("PostgreSQL is not installed (apt-get install postgresql)")


def as_ordinary_user() -> list[str]:
    """What goes before a command so that root does not run it, since PostgreSQL refuses that."""
    if os.getuid() != 0:
        return []
    runuser = shutil.which("runuser")
    if runuser is None:
        raise NoServer("PostgreSQL does not run as root, and there is no runuser to be someone else")
    return [runuser, "-u", "postgres", "--"]


@contextmanager
def server() -> Iterator[str]:
    """URL of a fresh server while in the context; raises NoServer."""
    with stoppable_server() as running:
        yield running.url


class Running(NamedTuple):
    """A server that can be stopped and started under way, and that can hang: all its processes stand still."""

    url: str
    start: Callable[[], None]
    stop: Callable[[], None]
    hang: Callable[[], None]
    go_on: Callable[[], None]


@contextmanager
def stoppable_server() -> Iterator[Running]:
    """A fresh server while in the context; raises NoServer."""
    bin_folder, become = programs(), as_ordinary_user()
    with tempfile.TemporaryDirectory(prefix="armlink-pg-") as folder:
        data = Path(folder) / "data"
        if become:
            shutil.chown(folder, "postgres", "postgres")
        port = _free_port()
        _run([*become, bin_folder / "initdb", "-D", data, "-A", "trust", "-U", "armlink", "--no-sync"], folder)
        options = f"-c listen_addresses=127.0.0.1 -c port={port} -c unix_socket_directories={folder} -c fsync=off"
        control = [*become, bin_folder / "pg_ctl", "-D", data, "-w"]

        def start() -> None:
            _run([*control, "-l", Path(folder) / "log", "-t", "60", "-o", options, "start"], folder)

        def stop() -> None:
            _run([*control, "-m", "immediate", "stop"], folder)

        def signal_all(number: signal.Signals) -> None:
            first = int((data / "postmaster.pid").read_text().splitlines()[0])
            children = Path(f"/proc/{first}/task/{first}/children").read_text().split()
            every = [str(first), *children]  # one of the children may have ended meanwhile
            subprocess.run([*become, "kill", f"-{int(number)}", *every], stderr=subprocess.DEVNULL, check=False)

        def go_on() -> None:
            signal_all(signal.SIGCONT)

        start()
        try:
            yield Running(
                f"postgresql://armlink@127.0.0.1:{port}", start, stop, lambda: signal_all(signal.SIGSTOP), go_on
            )
        finally:
            if (data / "postmaster.pid").exists():
                go_on()
                stop()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _run(command: list[object], folder: str) -> None:
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise NoServer(f"{command[-1]}: {done.stdout.strip().splitlines()[-1:]}")
