"""A sweep in real time whose cycle stalls: the joints are enabled again and the reading is repeated."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from small_pair import ARMLINK, FALSE, describe, simulated

from calib.dataset import load_data

pytestmark = pytest.mark.slow

TRIES = 4


def wait(what: str, done: Callable[[], bool], job: "subprocess.Popen[str]") -> None:
    """Until `done`; fails where the job ends first."""
    end = time.monotonic() + 120
    while not done():
        assert job.poll() is None, f"{what}: {job.communicate()[1]}"
        assert time.monotonic() < end, what
        time.sleep(0.05)


def readings(folder: Path) -> int:
    """How many readings are on disk."""
    path = folder / "unloaded" / "readings.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return sum(json.loads(line)["kind"] == "reading" for line in lines if line.endswith("\n"))


@pytest.mark.long
@pytest.mark.parametrize("who", ["loop", "arm"])
def test_keep_going_repeats_the_reading_that_a_stall_interrupted(tmp_path: Path, who: str) -> None:
    describe(tmp_path, rate=100, deadline=0.25)
    bus = f"udp_multicast:239.74.172.{os.getpid() % 200 + 1}"
    words = ["sweep", "pair.yaml", "--bus", bus, "--out", "unloaded", "--yes", "--no-check-stops", "--keep-going", "50"]
    with simulated(tmp_path, bus) as (_, arm):
        job = subprocess.Popen(
            [ARMLINK, *words], cwd=tmp_path, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        wait("no reading", lambda: readings(tmp_path) >= 2, job)
        loop = int(Path(f"/proc/{job.pid}/task/{job.pid}/children").read_text().split()[0])
        pid = loop if who == "loop" else arm.pid
        for _ in range(TRIES):  # one stop may fall into the recovery of a stall that this machine made by itself
            os.kill(pid, signal.SIGSTOP)
            time.sleep(1.0)
            os.kill(pid, signal.SIGCONT)
            before = readings(tmp_path)
            wait("no reading after the stall", lambda: readings(tmp_path) >= before + 3, job)  # noqa: B023
            if any((stall.late_ms is not None) == (who == "loop") for stall in load_data(tmp_path / "unloaded").stalls):
                break
        job.send_signal(signal.SIGINT)
        said = " ".join(job.communicate(timeout=60)[1].split())
        assert job.returncode == 130, said
    expected = "the host was" if who == "loop" else "no joint has sent a reading for"
    assert f"{expected} " in said
    assert "enabling the joints again and repeating the reading" in said
    assert not any(word in said for word in FALSE), said
    data = load_data(tmp_path / "unloaded")
    (stall, *_) = [each for each in data.stalls if (each.late_ms is not None) == (who == "loop")]
    places = [f"{reading.sweep} {reading.index + 1}" for reading in data.readings]
    assert stall.reading in places, "the interrupted reading was made after all"
    assert len(set(places)) == len(places), "none was made twice"
