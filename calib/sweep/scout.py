"""The scout: servo-held poses at which every sensor is read, before anything is pressed."""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import DriveLimits, gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.motion.mover import Mover, Stalled
from calib.motion.static_reading import StaticReading, stack
from calib.plan.rough_gravity import GravityGuess, guess_gravity
from calib.plan.types import SweepPlan

SCOUT_ACCELERATION = 1.0
"""Nothing is known of the arm's weight yet [rad/s²]."""
SLOWER, SLOWEST = 0.4, 0.15
"""Factor on the acceleration after a joint did not follow, and where that ends [rad/s²]."""
SCOUT = "scout"


def run_scout(mover: Mover, plan: SweepPlan, done: Collection[int], save: Callable[[StaticReading], None]) -> None:
    """Read every scout pose that is not `done`, each passed to `save`; a pose that the drives cannot reach is left out.

    Raises Stalled where too few poses were reached to know the arm's weight.
    """
    n = mover.link.n
    everything = np.ones(n, dtype=bool)
    acceleration, last, unreached = SCOUT_ACCELERATION, mover.position.copy(), list[Stalled]()
    for index, pose in enumerate(plan.scout):
        if index in done:
            continue
        stalls = list[Stalled]()
        for goal in (np.array(pose), np.array(pose), last):
            try:
                mover.travel(goal, acceleration)
                break
            except Stalled as stall:
                stalls.append(stall)
                mover.come_to_rest()
                acceleration = max(SLOWER * acceleration, SLOWEST)
        if len(stalls) > 1:
            unreached.append(stalls[0])
            continue
        save(mover.rest(everything).within(SCOUT, index, everything))
        last = mover.position.copy()
    if len(plan.scout) - len(unreached) < 4:
        raise unreached[0]


def rough_model(arm: ArmFile, readings: Sequence[StaticReading]) -> GravityGuess:
    """The rough gravity model from the scout's readings among `readings`."""
    scouted = [reading for reading in readings if reading.sweep == SCOUT]
    limits, section = DriveLimits.of(arm), sweep_section(arm)
    return guess_gravity(
        gcomp_arm(arm),
        stack(scouted, "position"),
        stack(scouted, "torque"),
        stack(scouted, "motor_torque"),
        limits.rated,
        section.friction,
    )
