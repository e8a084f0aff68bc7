"""Creeps of OpenArm in which something pushes: a table in reach, the arm against its own body, a cable; no bus.

    .venv/bin/python tests/campaigns/creep_contacts.py --draws 20

A push by which the creeping joint would fall behind its target is a contact that the sweep itself names: its rows are
left out here. The rest goes to the fit, which must name it or not be bent by it. Exit status 1 for a silent wrong
torque constant (off by more than 1.5 % and by more than three standard deviations, and nothing named).
"""

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from drawn_creeps import DrawnCreep, draw_creep, pushed

from armlink.arm_file import load_arm
from armlink.arrays import Array
from calib.arm.kinematics import gcomp_arm
from calib.arm.sweep_section import CreepSection, SweepSection
from calib.fit.creep_fit import fit_rows
from calib.plan.creep_plan import plan_creep

GAIN = 0.015
STOPPED = 0.25
"""A push of so much of rated torque stops the creep: the position loop's pull at `sweep.creep.contact_lead`."""
STIFFNESS = 1500.0
"""Of a table or a cover [N/m]."""
HAND = np.array([0.0, 0.0, -0.1])
"""Point that meets it, in the last link's frame [m]."""


def plane_push(made: DrawnCreep, random: np.random.Generator, inner: bool) -> Array:
    """Torque (R,) [N·m] on each row's joint of a table below the arm, or of a cover beside its body (`inner`)."""
    model, data = made.simulated.plant.model, mujoco.MjData(made.simulated.plant.model)
    body = model.body("openarm_right_link5" if inner else "openarm_right_ee_base_link").id
    angles = made.rows.readings.position + made.truth.position_offset
    normal = np.array([0.0, -1.0, 0.0]) if inner else np.array([0.0, 0.0, 1.0])
    points, jacobians = np.empty((len(angles), 3)), np.empty((len(angles), 3, model.nv))
    for row, pose in enumerate(angles):
        data.qpos[: len(pose)] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        points[row] = data.xpos[body] + data.xmat[body].reshape(3, 3) @ HAND
        mujoco.mj_jac(model, data, jacobians[row], None, points[row], body)
    height = points @ normal
    depth = np.maximum(np.quantile(height, random.uniform(0.03, 0.15)) - height, 0.0)
    felt = -STIFFNESS * depth[:, None] * np.einsum("rx,rxj->rj", np.tile(normal, (len(angles), 1)), jacobians)
    return np.asarray(felt[np.arange(len(angles)), made.rows.swept])


def cable_push(made: DrawnCreep, rated: Array, random: np.random.Generator) -> Array:
    """Torque (R,) of a cable at one joint, taut over its whole range or beyond a place in it."""
    joint, rows = int(random.integers(0, len(rated))), made.rows
    own = rows.readings.position[:, joint]
    slack = own[rows.swept == joint].mean() if random.random() < 0.5 else -np.inf
    stretch = np.where(np.isfinite(slack), np.maximum(own - slack, 0.0), own - own[rows.swept == joint].mean())
    return np.where(rows.swept == joint, random.uniform(0.05, 0.12) * rated[joint] * stretch, 0.0)


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    given = parser.parse_args()
    section = SweepSection(creep=CreepSection(span=1.4, bin=0.1, speeds=(0.2, 0.12)))
    arm = load_arm("openarm").model_copy(update={"sweep": section})
    plan, rated, described = plan_creep(arm), arm.require_link().rated_torques, gcomp_arm(arm)
    silent = named = 0
    for seed in range(given.draws):
        random = np.random.default_rng([seed, 23])
        made = draw_creep(arm, plan, seed, plan.reference_mass)
        kind = ("table", "own body", "cable")[seed % 3]
        push = cable_push(made, rated, random) if kind == "cable" else plane_push(made, random, kind == "own body")
        gain = made.warm_gain[made.rows.swept]
        rows = pushed(made.rows, gain * push)
        hard = np.abs(push) > STOPPED * rated[rows.swept]
        stopped = np.unique(rows.readings.series[hard])
        fit = fit_rows(described, rows.kept(~np.isin(rows.readings.series, stopped)), rated)
        found = fit.found_gain & ~np.isin(fit.names, [each.joint for each in fit.findings if each.kind == "spring"])
        off = np.where(found, np.abs(fit.value("gain") / made.warm_gain - 1), 0.0)
        wrong = bool(((off > GAIN) & (off > 3 * fit.std("gain") / made.warm_gain)).any())
        told = bool(len(stopped) or fit.findings)
        silent, named = silent + (wrong and not told), named + told
        light = float(
            np.abs(
                push[~np.isin(rows.readings.series, stopped)]
                / rated[rows.swept[~np.isin(rows.readings.series, stopped)]]
            ).max()
        )
        print(
            f"{seed:>3} {kind:>8}: stopped {len(stopped)} sweeps, left {light:.1%} of rated torque, fit names"
            f" {len(fit.findings)}, gains within {off.max():.2%}{' WRONG' if wrong else ''}",
            flush=True,
        )
    print(f"{given.draws} draws, {named} named, {silent} silently wrong")
    return int(silent > 0)


if __name__ == "__main__":
    sys.exit(main())
