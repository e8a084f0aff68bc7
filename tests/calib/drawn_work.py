"""Ordinary work of drawn arms without torque sensors, as passages: gravity by MuJoCo, friction of the truth."""

from dataclasses import dataclass

import numpy as np
from drawn_creeps import DrawnCreep

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import gcomp_arm
from calib.motion.static_reading import StaticReading
from calib.observer.row_makers import WIDTH
from calib.records.records import CalibrationRecord

SPEEDS = (0.1, 0.6)
"""Of ordinary work [rad/s]."""
PAUSE = 1.0
"""Between two motions [s]."""


@dataclass(frozen=True)
class Change:
    """What changes on an arm."""

    gain: float = 1.0
    """Factor on a joint's reading."""
    friction: float = 1.0
    """Factor on its friction."""
    joint: int = 0
    payload: float = 0.0
    """[kg], where the reference mass hung."""


NOTHING = Change()


def work(
    arm: ArmFile, made: DrawnCreep, record: CalibrationRecord, random: np.random.Generator, rows: int,
    change: Change = NOTHING,
) -> list[StaticReading]:  # fmt: skip
    """So many passages of motions of one to three joints at a time between random poses; time goes on from motion to
    motion. Readings are corrected by the record."""
    simulated = made.simulated
    described = gcomp_arm(arm)
    limits = np.stack([described.lower, described.upper], axis=1)
    n, found = described.n, list[StaticReading]()
    simulated.attach_mass(change.payload)
    held = record.torque_calibration(TorqueCalibration(np.ones(n), np.zeros(n)))
    here = limits.mean(axis=1)
    while len(found) < rows:
        goal, moving = here.copy(), random.choice(n, size=random.integers(1, 4), replace=False)
        goal[moving] = random.uniform(*(0.9 * limits[moving]).T)
        way = goal - here
        rate = random.uniform(*SPEEDS)
        velocity = rate * way / np.abs(way).max()
        seconds = np.abs(way).max() / rate
        for k in range(int(np.abs(way).max() / WIDTH)):
            t = simulated.time + (k + 0.5) * WIDTH / rate
            q = here + velocity * (k + 0.5) * WIDTH / rate
            for joint in np.flatnonzero(np.abs(velocity) > 0.03):
                torque = _reading(made, q, int(joint), float(velocity[joint]), t, random, change)
                corrected = (torque - held.offset[joint]) / held.gain[joint]
                heat = float(np.floor(simulated.sensors.heating(t)[joint]))
                found.append(StaticReading.of_motion(t, int(joint), q, corrected, float(velocity[joint]), heat))
        simulated.time += seconds + PAUSE
        here = goal
    simulated.attach_mass(0.0)
    return found[:rows]


def _reading(
    made: DrawnCreep, q: Array, joint: int, rate: float, t: float, random: np.random.Generator, change: Change
) -> float:
    simulated, state, truth = made.simulated, made.state, made.truth
    angles = q * truth.position_gain + truth.position_offset
    gravity = float(simulated.gravity_torque(angles[None])[0, joint])
    side, own = np.sign(rate), angles[joint]
    amplitude, phase, by_load, _ = state.uneven[joint]
    level = state.coulomb[joint] * (1 + amplitude * np.sin(own + phase)) + by_load * abs(gravity)
    level = level * (1 + state.leaning[joint] * side)
    ripple, cycles, at = state.cogging[joint]
    mine = change.joint == joint
    friction = side * level * (change.friction if mine else 1.0)
    motor = gravity + friction + state.viscous[joint] * rate + 0.1 * ripple * np.sin(cycles * own + at)
    gain = simulated.sensors.gain_at(t)[joint] * (change.gain if mine else 1.0)
    noise = 0.02 * state.coulomb[joint] * random.standard_normal()
    return float(gain * motor + simulated.sensors.offset[joint] + noise)
