"""The live stream, received by Rerun's own program, which writes it to a file."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from armlink.errors import BadInput
from armlink.link.types import Sample
from armlink.monitor.streams import RerunStream

NAMES = ("shoulder", "elbow")
T = TypeVar("T")
RERUN = [sys.executable, "-m", "rerun"]
installed = pytest.mark.skipif(find_spec("rerun") is None, reason="rerun-sdk is not installed")


def sample() -> Sample:
    values = {"position": [1.25, np.nan], "velocity": [np.nan] * 2, "torque": [0.5, 2.75], "motor_torque": [np.nan] * 2}
    arrays = {name: np.array(each) for name, each in values.items()}
    return Sample(t=0.0, status=np.zeros(2, int), age=np.zeros(2), **arrays)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def viewer(port: int, file: Path) -> Iterator[None]:
    """Rerun's program, which writes what it receives to a file; interrupted at the end, as by Ctrl-C."""
    options = ["--port", str(port), "--bind", "127.0.0.1", "--save", str(file)]
    with subprocess.Popen([*RERUN, *options], stderr=subprocess.DEVNULL, start_new_session=True) as program:
        try:
            yield
        finally:
            os.killpg(program.pid, signal.SIGINT)


def until(done: Callable[[], T | None]) -> T:
    """What `done` returns once it is something."""
    for _ in range(1200):
        if (found := done()) is not None:
            return found
        time.sleep(0.05)
    raise AssertionError("it did not come within a minute")


def connected(port: int) -> RerunStream | None:
    try:
        return RerunStream("pair", NAMES, port)
    except BadInput:
        return None


@installed
def test_a_viewer_gets_what_is_there_as_a_time_series_a_joint(tmp_path: Path) -> None:
    port, file = free_port(), tmp_path / "got.rrd"
    expected = {"position/rad/shoulder": 1.25, "torque/newton_metres/shoulder": 0.5, "torque/newton_metres/elbow": 2.75}
    with viewer(port, file):
        with until(lambda: connected(port)) as stream:
            stream.send(sample())
        assert until(lambda: found if len(found := values_in(file)) == len(expected) else None) == expected


def values_in(file: Path) -> dict[str, float]:
    """Entity → its value, as Rerun prints them; nothing while the file cannot be read yet."""
    done = subprocess.run([*RERUN, "rrd", "print", "-vvv", str(file)], capture_output=True, text=True, check=False)
    found = {}
    for chunk in done.stdout.split("Chunk(")[1:]:
        path, value = re.search(r"entity_path: /(\S+)", chunk), re.search(r"\[(-?\d+\.\d+)\]", chunk)
        if path and value:
            found[path[1]] = float(value[1])
    return found


@installed
def test_no_viewer_is_one_line() -> None:
    port = free_port()
    says = f"--rerun {port}: there is no viewer on this port .*: start a viewer with rerun --port {port}"
    with pytest.raises(BadInput, match=says):
        RerunStream("pair", NAMES, port)


def test_without_the_package_it_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(BadInput, match=r"\(extra rerun\) is not installed: .* -m pip install "):
        RerunStream("pair", NAMES, 9876)
