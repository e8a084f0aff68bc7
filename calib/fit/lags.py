"""Lag of sensors and cables: where in its play each was at every reading, on the way from one to the next.

A sensor's reading lags behind torque, a cable's pull behind the joint's turn, each as a play: it stays until the end of
the play takes it along (docs/theory.md, 4.6). Joints that are held keep the lag that their last change left.
"""

from dataclasses import dataclass

import numpy as np

from calib.fit.sweep_readings import SweepReadings
from calib.plan.types import APPROACH
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

TURNS = (0.1, 0.3, 0.8)
"""Half widths of a cable's play in a joint's turn [rad]: short and long ones, between which real ones lie; the longest
for a cable that this joint bends less than another."""
TORQUE = 5e-4
"""Half width of a sensor's play, as a share of rated torque: accuracy class 0.05."""
STEPS = 4
"""Points on a straight way at which the torque is computed."""


@dataclass(frozen=True, eq=False)
class Lags:
    """Place of each play at K readings, -1 to 1; all zeros where the way is not known."""

    cable: Array
    """Of each of TURNS and joint (3, K, n)."""
    sensor: Array
    """Of each joint's torque sensor (K, n)."""

    @classmethod
    def unknown(cls, count: int, n: int) -> "Lags":
        """Of readings whose way is not known."""
        return cls(np.zeros((len(TURNS), count, n)), np.zeros((count, n)))

    @classmethod
    def of(cls, arm: Arm, rows: SweepReadings, parameters: Parameters, rated: Array) -> "Lags":
        """On straight ways between the readings, each approached from the side that it tells; rated (n,) [N·m]."""
        position, load = rows.readings.position, rows.readings.load
        approach = position - APPROACH * rows.readings.direction * rows.own
        way = np.stack([approach, position], axis=1).reshape(-1, arm.n)
        cable = np.array([play(way, np.full(arm.n, width))[1::2] for width in TURNS])
        before = np.vstack([way[:1], way[:-1]])
        shares = np.arange(1, STEPS + 1) / STEPS
        finer = (before[:, None] + shares[:, None] * (way - before)[:, None]).reshape(-1, arm.n)
        nothing = np.zeros((len(finer), arm.n))
        loads = np.repeat(load, 2 * STEPS)
        torque = predict(arm, parameters, StaticReadings.of(finer, nothing, 1.0, loads)) - parameters.offset
        sensor = play(torque / np.where(parameters.gain == 0, 1.0, parameters.gain), TORQUE * rated)
        return cls(cable, -sensor[2 * STEPS - 1 :: 2 * STEPS])


def play(values: Array, half: Array) -> Array:
    """How far values (K, n), one after the other, are ahead of a play of half widths (n,), in these (K, n)."""
    held, ahead = values[0].copy(), np.empty_like(values)
    for row, value in enumerate(values):
        held = np.minimum(np.maximum(held, value - half), value + half)
        ahead[row] = value - held
    return ahead / half
