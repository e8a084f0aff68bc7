"""Weighing: torques at rest in poses that tell a payload best, or half sums of creeps, and the payload behind them.

Poses that the drives cannot hold with the payload are left out, as in a verification.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from armlink.loop.driver import ArmDriver
from calib.arm.sweep_section import sweep_motion, sweep_section
from calib.fit.payload import Payload, raw_readings, weigh_payload
from calib.plan.sweep_options import weighing_poses
from calib.records.records import CalibrationRecord, GravityRecord
from calib.sweep.sweep_pass import OnStall, give_up
from calib.sweep.verify import run_verify

FEWEST = 2
"""Poses without which mass and place cannot be told apart (docs/theory.md, section 6.4)."""


def run_weigh(
    link: ArmDriver,
    arm_file: ArmFile,
    gravity: GravityRecord,
    calibration: CalibrationRecord,
    *,
    poses: int = 12,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    on_stall: OnStall = give_up,
) -> tuple[Payload, int]:
    """(The payload, number of poses that were reached). The link must have been enabled.

    Raises Refused where a record is of another arm or too few poses are reached, BadInput, BusFault.
    """
    creeping = sweep_motion(arm_file) == "creep"
    found = run_verify(
        link,
        arm_file,
        gravity,
        calibration,
        poses=poses,
        seed=seed,
        at=None if creeping else partial(weighing_poses, arm_file, poses, seed),
        progress=progress,
        on_stall=on_stall,
    )
    reached = len(found.sensor)
    if reached < FEWEST:
        raise Refused(f"{reached} of {poses} poses were reached: can the drives hold the load?")
    sigma = sweep_section(arm_file).standard_error * arm_file.require_link().rated_torques
    readings = raw_readings(found.position, found.sensor, np.maximum(sigma, 1e-9), calibration)
    if creeping:  # half sums of both directions
        readings = replace(readings, direction=np.zeros_like(readings.direction))
    return weigh_payload(arm_file, readings, gravity, calibration), reached
