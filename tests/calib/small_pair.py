"""A two-joint arm whose sweeps are short, and a simulated one of it in real time, in a process of its own."""

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ARMLINK = str(Path(sys.executable).with_name("armlink"))
SEED, MASS = 3, 1.5
FALSE = ("encoder", "cable", "too weak", "babbles", "second node", "stuck")
"""What no line may say of a sound arm."""
CONTENT: dict[str, Any] = {
    "name": "pair",
    "serial": "VCAN",
    "kinematics": {
        "gravity": [9.81, 0.0, 0.0],
        "joints": [
            {"name": "j1", "a": 0.4, "lower": 1.0, "upper": 2.2},
            {"name": "j2", "a": 0.3, "lower": -0.6, "upper": 0.6},
        ],
    },
    "link": {
        "deadline": 0.5,
        "joints": [
            {"name": "j1", "node": 1, "rated_torque": 60.0, "max_torque": 60.0, "max_velocity": 2.0},
            {"name": "j2", "node": 2, "rated_torque": 30.0, "max_torque": 30.0, "max_velocity": 2.0},
        ],
    },
    "sweep": {
        "steps": 5,
        "poses": 1,
        "gain_std": 0.01,
        "settle_timeout": 1.5,
        "approach_speed": 0.8,
        "acceleration": 10.0,
    },
    "sim": {
        "links": [
            {"mass": 3.0, "com": [-0.15, 0.02, 0.1], "inertia": [0.03, 0.03, 0.03]},
            {"mass": 2.0, "com": [0.2, 0.03, 0.0], "inertia": [0.02, 0.02, 0.02]},
        ],
        "sensors": {"noise": [0.0, 0.0], "bits": 20},
    },
}


def describe(folder: Path, **link: Any) -> Path:
    """An arm file of it, with these keys in its link section."""
    path = folder / "pair.yaml"
    path.write_text(yaml.safe_dump({**CONTENT, "link": {**CONTENT["link"], **link}}))
    return path


def armlink(folder: Path, *words: str, ok: tuple[int, ...] = (0,), tries: int = 1) -> dict[str, Any]:
    """A command's answer; the line that it ended with where it failed. `tries` where a busy machine keeps the simulated
    arm from answering in time."""
    answer = folder / "answer.json"
    for _ in range(tries):
        done = subprocess.run([ARMLINK, *words, "--json", str(answer)], capture_output=True, text=True, cwd=folder)
        if "no reading for" not in done.stderr:
            break
    assert done.returncode in ok, done.stderr
    assert not any(word in done.stderr for word in FALSE), done.stderr
    return dict(json.loads(answer.read_text()))


@contextlib.contextmanager
def on_bus(folder: Path, arm: str, bus: str, seed: int) -> Iterator[tuple[Path, "subprocess.Popen[bytes]"]]:
    """A simulated arm in real time on this bus, seen from `folder`; its control pipe and its process."""
    pipe = folder / "arm.pipe"
    words = ["sim", arm, "--bus", bus, "--seed", str(seed), "--control", str(pipe)]
    with subprocess.Popen([ARMLINK, *words], cwd=folder, stderr=subprocess.DEVNULL) as process:
        while not pipe.exists():
            assert process.poll() is None, "the simulated arm has ended"
            time.sleep(0.1)
        try:
            yield pipe, process
        finally:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGTERM)


def simulated(
    folder: Path, bus: str, seed: int = SEED
) -> contextlib.AbstractContextManager[tuple[Path, "subprocess.Popen[bytes]"]]:
    """The arm of `folder` likewise."""
    return on_bus(folder, "pair.yaml", bus, seed)
