"""A fleet's recordings diagnosed on a local cluster: two workers against one."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
from side_by_side import Case

from armlink.recording.files import save_recording
from armlink.recording.recording import Recording
from sim_gap.fleet import cluster, diagnose_fleet, find_cases

RECORDINGS = 200
SECONDS, RATE = 15.0, 50.0
ARM = """
<mujoco><worldbody>
<body><joint name="shoulder" axis="0 1 0"/><inertial pos="0 0 0.2" mass="4" diaginertia=".05 .05 .01"/>
<body pos="0 0 .4"><joint name="elbow" axis="0 1 0"/>
<inertial pos="0 .02 .15" mass="2" diaginertia=".02 .02 .005"/></body>
</body></worldbody></mujoco>
"""


def cases() -> list[Case]:
    """One case: recordings per second, each measured with a running cluster."""
    scratch = TemporaryDirectory(prefix="armlink-fleet-")  # lives as long as the functions that use it
    folder = Path(scratch.name)
    (folder / "sim.xml").write_text(ARM, encoding="utf-8")
    (folder / "runs").mkdir()
    for number in range(RECORDINGS):
        save_recording(_recording(number), folder / "runs" / f"run_{number:03d}.parquet")

    def on(workers: int) -> float:
        with cluster(None, workers) as client:
            found = find_cases(Path(scratch.name) / "runs", folder / "sim.xml")
            list(diagnose_fleet(found[: 2 * workers], client))  # every worker has loaded its modules
            start = time.perf_counter()
            answers = dict(diagnose_fleet(found, client))
            taken = time.perf_counter() - start
        assert len(answers) == RECORDINGS
        assert not any("error" in answer for answer in answers.values())
        return RECORDINGS / taken

    name, peer = "fleet_2_workers_vs_1", "the same on one worker"
    return [Case(name, "recordings/s", lambda: on(2), lambda: on(1), peer, less_is_better=False, runs=1, warm_up=False)]


def _recording(seed: int) -> Recording:
    """Smooth random motion with dry friction on the elbow, its torque by MuJoCo's inverse dynamics."""
    random, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(ARM)
    data, t = mujoco.MjData(model), np.arange(0.0, SECONDS, 1.0 / RATE)
    omega, phase = 2 * np.pi * random.uniform(0.1, 0.5, (2, 3, 1)), random.uniform(0, 2 * np.pi, (2, 3, 1))
    q = (0.4 * np.sin(omega * t + phase)).sum(1).T
    v = (0.4 * omega * np.cos(omega * t + phase)).sum(1).T
    a = (-0.4 * omega**2 * np.sin(omega * t + phase)).sum(1).T
    torque = np.empty_like(q)
    for row in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], v[row], a[row]
        mujoco.mj_inverse(model, data)
        torque[row] = data.qfrc_inverse
    motor = torque + [0.0, 0.5] * np.tanh(v / 0.002) + 0.01 * random.normal(size=q.shape)
    return Recording(t=t, position=q, torque=torque + 0.01 * random.normal(size=q.shape), motor_torque=motor)
