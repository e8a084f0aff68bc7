"""Campaign: a fleet's recordings on one worker and on two, and with a worker killed in the middle.

python tests/campaigns/fleet_speed.py [--recordings 200] [--seconds 12] [--joints 3]
Needs two cores with nothing else on them. Exit status 1 if two workers are less than 1.7 times as fast as one, or if an
answer is missing or another after the kill.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armlink.recording import Recording, save_recording
from sim_gap.cluster import cluster
from sim_gap.fleet import Case, diagnose_fleet, find_cases

LEAST = 1.7
RATE = 100.0
NOISE_NM = 0.02
SINES_HZ, SWING = np.array([0.08, 0.2, 0.4]), 0.15


def chain(joints: int) -> str:
    """MJCF of an arm whose axes turn by a right angle from joint to joint."""
    open_, close = "", ""
    for j in range(joints):
        axis, mass = ("0 1 0", "1 0 0")[j % 2], 5.0 / (j + 1)
        open_ += f'<body name="link_{j + 1}" pos="0 0 0.3"><joint name="joint_{j + 1}" axis="{axis}"/>'
        open_ += f'<inertial pos="0.02 0.01 0.15" mass="{mass:.3g}" diaginertia="0.05 0.05 0.02"/>'
        close += "</body>"
    return f"<mujoco><worldbody>{open_}{close}</worldbody></mujoco>"


def write_fleet(folder: Path, recordings: int, seconds: float, joints: int) -> Path:
    """Recordings of as many arms, friction on every joint of each; returns the model's file."""
    model = mujoco.MjModel.from_xml_string(chain(joints))
    path = folder / "sim.xml"
    mujoco.mj_saveLastXML(str(path), model)
    for number in range(recordings):
        save_recording(record(model, number, seconds), folder / f"run_{number:04d}.parquet")
    return path


def record(model: mujoco.MjModel, seed: int, seconds: float) -> Recording:
    """Smooth motion with Coulomb friction of a random size on every joint."""
    random, data, t = np.random.default_rng(seed), mujoco.MjData(model), np.arange(0.0, seconds, 1.0 / RATE)
    shape = 3, model.nv, 1
    omega, phase = 2 * np.pi * SINES_HZ[:, None, None] * random.uniform(0.8, 1.2, shape), random.uniform(0, 6, shape)
    q = (SWING * np.sin(omega * t + phase)).sum(0).T
    v = (SWING * omega * np.cos(omega * t + phase)).sum(0).T
    a = (-SWING * omega**2 * np.sin(omega * t + phase)).sum(0).T
    torque = np.empty_like(q)
    for row in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], v[row], a[row]
        mujoco.mj_inverse(model, data)
        torque[row] = data.qfrc_inverse
    noise = NOISE_NM * random.normal(size=(2, *q.shape))
    motor = torque + random.uniform(0.3, 1.0, model.nv) * np.tanh(v / 0.002)
    return Recording(t=t, position=q, velocity=v, torque=torque + noise[0], motor_torque=motor + noise[1])


def timed(cases: list[Case], workers: int, kill: bool = False) -> tuple[float, dict[str, Any]]:
    """Seconds from the first case handed out to the last answer, workers being up, and the answers."""
    answers: dict[str, Any] = {}
    with cluster(None, workers) as client:
        client.wait_for_workers(workers)
        client.run(_ready)
        started = time.monotonic()
        for count, (case, answer) in enumerate(diagnose_fleet(cases, client), start=1):
            answers[case] = answer
            if kill and count == len(cases) // 3:
                os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
        return time.monotonic() - started, answers


def _ready() -> None:
    import sim_gap.diagnose  # noqa: F401 - imported once before the clock starts


def main() -> int:
    """Time both, then kill."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--joints", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="armlink-fleet-") as scratch:
        model = write_fleet(Path(scratch), given.recordings, given.seconds, given.joints)
        cases = find_cases(Path(scratch), model)
        two, first = timed(cases, 2)
        print(f"two workers: {two:.1f} s for {len(first)} recordings", flush=True)
        one, second = timed(cases, 1)
        print(f"one worker: {one:.1f} s; two are {one / two:.2f} times as fast (asked: {LEAST})", flush=True)
        _, third = timed(cases, 2, kill=True)
    lost = len(cases) - len(third)
    same = first == second == third
    print(f"a worker killed after {len(cases) // 3} answers: {lost} lost, answers {'the same' if same else 'DIFFER'}")
    return 0 if one / two >= LEAST and not lost and same else 1


if __name__ == "__main__":
    sys.exit(main())
