"""The arm as it hangs and with what it carries, as far as a recording tells: effects of the arm, no faults."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.checks.rigid_fit import FLOOR, ChannelMotion, fit_rigid
from sim_gap.model.rigid_body import RigidArm

MOUNTED = 0.1
"""Share of the readings' variance that may be left (geometric mean) for gravity along another axis to count."""
UPSIDE_DOWN = 0.98
"""Cosine from which gravity is nearly opposite: then a turned sign of all torques is as good, and far more common."""
TOOL_REACH = 0.4
"""Farthest centre of mass of a tool from the last joint, as a share of the arm's length; or the last link's end, which
is twice as far away as the link's own centre of mass."""


def find_mounting(arm: RigidArm, motion: ChannelMotion) -> RigidArm:
    """The arm with gravity along the axis that fits best, if that is better than the nominal one.

    A tilted base is an effect of the arm, which the diagnosis finds; no fault of the data must be seen in it.
    """
    still = np.zeros_like(motion.q)
    weightless = arm.torque(motion.q, motion.v, motion.a, np.zeros(3)) + arm.spring_torque(motion.q)
    columns = np.stack([arm.torque(motion.q, still, still, axis) for axis in np.eye(3)], axis=-1)
    weight = 1.0 / (motion.reading.std(0) + 1e-9)
    left = ((motion.reading - weightless) * weight).ravel()
    gravity = np.linalg.lstsq((columns * weight[:, None]).reshape(-1, 3), left, rcond=None)[0]
    size, nominal = float(np.linalg.norm(gravity)), float(np.linalg.norm(arm.gravity))
    if size < 1e-6 or nominal < 1e-6:
        return arm
    turned = replace(arm, gravity=gravity * nominal / size)
    found, plain = fit_rigid(turned, motion).cost, fit_rigid(arm, motion).cost
    opposite = fit_rigid(arm, replace(motion, reading=-motion.reading)).cost
    upside_down = float(gravity @ arm.gravity) < -UPSIDE_DOWN * size * nominal
    if found.sum() > plain.sum() or found.mean() > np.log(MOUNTED + FLOOR):
        return arm
    return arm if upside_down and opposite.sum() < found.sum() + 0.3 else turned


def find_load(arm: RigidArm, motion: ChannelMotion, without: int | None = None) -> RigidArm:
    """The arm with the body at its last link that fits best, if it explains the readings and may exist.

    Args:
        arm: arm as mounted.
        motion: motion with the readings.
        without: joint whose reading is not believed, if any.

    A tool that outweighs a slim last link turns the direction of its mass moment: alone, that looks as if the joint's
    zero were off. A zero that is off needs a moment without a mass.
    """
    tip, believed = arm.n - 1, [j for j in range(arm.n) if j != without]
    body, _ = body_at(arm, motion, tip, believed)
    reach = TOOL_REACH * float(np.linalg.norm(arm.offset[1:], axis=1).sum())
    link = arm.inertial[tip]
    end = 2.0 * float(np.linalg.norm(link[1:4]) / max(link[0], 1e-9))
    if body[0] <= 0.0 or float(np.linalg.norm(body[1:])) > max(reach, end, 1e-9) * body[0]:
        return arm
    inertial = arm.inertial.copy()
    inertial[tip, :4] += body
    loaded = arm.with_inertial(inertial)
    found, plain = fit_rigid(loaded, motion).cost[believed], fit_rigid(arm, motion).cost[believed]
    return loaded if found.sum() < plain.sum() and found.mean() < np.log(MOUNTED + FLOOR) else arm


def body_at(
    arm: RigidArm, motion: ChannelMotion, link: int, joints: Sequence[int] | None = None
) -> tuple[Array, Array]:
    """Mass and mass moment (4,) of a body at a link that fits best, of any sign, and its torque (K, n).

    `joints` are those whose readings are fitted, by default all; friction, rotor and offset of each joint are its own.
    """
    columns = arm.link_regressor(arm.motion(motion.q, motion.v, motion.a), link)[:, :, :4]
    left = motion.reading - arm.carried(motion.q, motion.v, motion.a)
    wide, sides = [], []
    for j in range(arm.n) if joints is None else joints:
        own = np.stack([motion.direction[:, j], motion.v[:, j], motion.a[:, j], np.ones(len(left))], axis=1)
        both = np.column_stack([columns[:, j], left[:, j]])
        rest = (both - own @ np.linalg.lstsq(own, both, rcond=None)[0]) / (motion.reading[:, j].std() + 1e-9)
        wide.append(rest[:, :4])
        sides.append(rest[:, 4])
    body = np.linalg.lstsq(np.concatenate(wide), np.concatenate(sides), rcond=None)[0]
    return body, columns @ body
