"""The exported model in MuJoCo and, batched, in MuJoCo Warp: the same held-out motion, and a batch of posterior draws.

    python tests/campaigns/batched_replay.py --sim MODEL.xml --train REC … --heldout REC … [--worlds 1024] [--seconds 6]

The corrected model is exported without callbacks and replayed along the commands of the first held-out recording, by
MuJoCo and by MuJoCo Warp on this processor. Printed are, per joint, the RMS of the gap to the measured position by both
and of the difference between both, as a share of that gap; and how long a step of all worlds took, each with a draw of
gain, friction and rotor inertia from the posterior. Needs `pip install mujoco-warp`, whose first run compiles for
minutes.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlink.recording.files import load_recording
from armlink.recording.recording import slice_rows
from sim_gap.attribution.diagnose import diagnose
from sim_gap.better_model.native_drives import hold
from sim_gap.position_gap.identify import Identified
from sim_gap.position_gap.training.position_files import export_batched
from sim_gap.position_gap.training.replay import Simulated, actuator_of, commanded_rows, replay
from sim_gap.position_gap.training.spread import draw
from sim_gap.position_gap.windows import WARM_S

AGREE = 0.05
"""Largest difference of the RMS gap to the measured position between both simulators, over all joints."""


def warp_replay(model: Any, joints: list[int], recording: Any, rows: int) -> np.ndarray:
    """Positions at the first `rows` rows, (rows, n), by MuJoCo Warp in one world."""
    import mujoco
    import mujoco_warp as mjw
    import warp as wp

    data = mujoco.MjData(model)
    adr = model.jnt_qposadr[joints]
    data.qpos[adr] = recording.position[0]
    drives = [actuator_of(model, joint) for joint in joints]
    hold(model, data, drives, recording.position_command[0])
    controls = model.actuator_ctrladr[drives]
    m, d = mjw.put_model(model), mjw.put_data(model, data)
    dt, times = float(model.opt.timestep), recording.t[:rows]
    out, at = np.empty((rows, len(joints))), 0
    ctrl = np.zeros((1, d.ctrl.shape[1]), np.float32)
    for k in range(int((times[-1] - times[0]) / dt) + 1):
        now = times[0] + k * dt
        if at + 1 < rows and times[at + 1] <= now + 1e-9:
            q = d.qpos.numpy()[0, adr]
            while at + 1 < rows and times[at + 1] <= now + 1e-9:
                out[at + 1] = q
                at += 1
        ctrl[0, controls] = recording.position_command[at]
        wp.copy(d.ctrl, wp.array(ctrl, dtype=float))
        mjw.step(m, d)
    out[0], out[at + 1 :] = recording.position[0], d.qpos.numpy()[0, adr]
    return out


def batch_seconds(
    model: Any, joints: Sequence[int], names: Sequence[str], rows: Sequence[Mapping[str, float]], steps: int
) -> tuple[float, float]:
    """Processor seconds of a step of all worlds, a draw in each, and the spread of their positions at the end [rad]."""
    import mujoco_warp as mjw
    import warp as wp

    worlds = len(rows)
    sized = ("dof_frictionloss", "dof_armature", "actuator_gainprm", "actuator_biasprm")
    m = mjw.put_model(model, batch_sizes=dict.fromkeys(sized, worlds))
    d = mjw.make_data(model, nworld=worlds)
    dofs = [int(model.jnt_dofadr[joint]) for joint in joints]
    drives = [actuator_of(model, joint) for joint in joints]
    values = {name: np.array(getattr(m, name).numpy()) for name in sized}
    for w, row in enumerate(rows):
        for j, joint in enumerate(names):
            own = {p: row.get(f"{joint}.{p}") for p in ("coulomb", "armature", "kp")}
            for field, p in (("dof_frictionloss", "coulomb"), ("dof_armature", "armature")):
                if own[p] is not None:
                    values[field][w, dofs[j]] = own[p]
            if own["kp"] is not None:
                values["actuator_gainprm"][w, drives[j], 0] = own["kp"]
                values["actuator_biasprm"][w, drives[j], 1] = -own["kp"]
    for name, x in values.items():
        getattr(m, name).assign(x)
    wp.copy(d.ctrl, wp.array(np.full(d.ctrl.shape, 0.3, np.float32), dtype=float))
    mjw.step(m, d)
    started = time.process_time()
    for _ in range(steps):
        mjw.step(m, d)
    spread = float(d.qpos.numpy().std(0).max())
    return (time.process_time() - started) / steps, spread


def main() -> None:
    """Diagnose, export, replay in both, print."""
    import mujoco

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sim", type=Path, required=True)
    parser.add_argument("--train", type=Path, nargs="+", required=True)
    parser.add_argument("--heldout", type=Path, nargs="+", required=True)
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=6.0)
    given = parser.parse_args()
    answer = diagnose(
        given.sim, [load_recording(p) for p in given.train], [load_recording(p) for p in given.heldout], progress=print
    )
    found = answer.internals
    assert isinstance(found, Identified)
    assert found.export is not None
    model = mujoco.MjModel.from_xml_string((export_batched(found) or found.export).xml)
    recording = slice_rows(found.recordings[0], commanded_rows(found.recordings[0])[0])
    t, ours, measured = replay(Simulated(model, found.sim.joints), recording)
    rows = int(np.searchsorted(t, t[0] + given.seconds))
    started = time.process_time()
    theirs = warp_replay(model, list(found.sim.joints), recording, rows)
    judged = t[:rows] >= t[0] + WARM_S
    gaps = [np.sqrt(np.mean((x[:rows] - measured[:rows])[judged] ** 2, axis=0)) for x in (ours, theirs)]
    apart = np.sqrt(np.mean((ours[:rows] - theirs)[judged] ** 2, axis=0))
    print(f"MuJoCo {gaps[0]} rad, MuJoCo Warp {gaps[1]} rad, apart {apart} rad, {time.process_time() - started:.0f} s")
    pooled = [float(np.linalg.norm(gap)) for gap in gaps]
    share = abs(pooled[1] / pooled[0] - 1.0)
    print(f"RMS over all joints differs by {share:.2%}: {'within' if share < AGREE else 'NOT within'} {AGREE:.0%}")
    drawn = draw(found.search, found.fit, found.spread, given.worlds, reach=found.band.reach)
    seconds, spread = batch_seconds(model, found.sim.joints, found.sim.arm.names, drawn, given.steps)
    print(f"{given.worlds} worlds with draws: {seconds * 1e3:.1f} ms of processor time a step, spread {spread:.4f} rad")


if __name__ == "__main__":
    main()
