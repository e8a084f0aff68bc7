"""Whether a plan is one that the planner could have made of this arm file: its shape, poses, torques and accelerations.

A plan on disk may have been changed since it was made, and so may the arm file.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import Refused
from calib.arm.kinematics import DriveLimits
from calib.plan.planned_arm import FASTEST, SLOWEST, PlannedArm
from calib.plan.types import Sweep, SweepPlan
from gcomp.arrays import Array

ROUNDING = 1e-6
"""Share of a value, or [rad], by which arithmetic in another order may differ: far above that of 64-bit numbers."""


Ends = tuple[Array, Array]
"""Lower and upper bounds of poses, each (n,) [rad]."""


def check_limits(arm_file: ArmFile, plan: SweepPlan) -> None:
    """Raise Refused, naming sweep, joint and value, where a plan of static readings leaves the arm file's limits."""
    planned = PlannedArm(arm_file)
    require_bounds(arm_file, plan, planned.ends, (planned.limits.lower, planned.limits.upper))
    refuse_unfit(arm_file, _of_drives(plan, planned))


def check_bias(arm_file: ArmFile, plan: SweepPlan) -> None:
    """Raise Refused where a plan does not say how resting joints are pressed, as one from before the scout."""
    refuse_unfit(arm_file, (f"sweep {sweep.name}: `bias` is missing" for sweep in plan.sweeps if sweep.bias is None))


def require_bounds(arm_file: ArmFile, plan: SweepPlan, servoed: Ends, pressed: Ends) -> None:
    """Raise Refused where a plan has another number of joints, or a pose beyond the bounds: of joints that their servo
    moves or holds, scout poses included, and of those on a stop."""
    refuse_unfit(arm_file, _of_shape(plan, len(arm_file.joint_names)))
    refuse_unfit(arm_file, _of_poses(plan, servoed, pressed, arm_file.joint_names))


def refuse_unfit(arm_file: ArmFile, found: Iterator[str]) -> None:
    """Raise Refused with the first of what does not fit, if anything does not."""
    first = next(found, None)
    if first is not None:
        raise Refused(
            f"{arm_file.name}: the plan of this data set does not fit the arm file: {first}: was the plan or "
            "the arm file changed since the plan was made? Begin a new pass in another directory"
        )


def _of_shape(plan: SweepPlan, n: int) -> Iterator[str]:
    if not plan.scout:
        yield "the plan has no scout pose, expected at least one"
    for number, pose in enumerate(plan.scout, start=1):
        if len(pose) != n:
            yield f"scout pose {number} has {len(pose)} joints, expected {n}"
    if plan.standard_error <= 0:
        yield f"standard_error is {plan.standard_error:g}, expected a number above 0"
    names = [sweep.name for sweep in plan.sweeps]
    for sweep in plan.sweeps:
        each = {"stops": sweep.stops, "rest": sweep.rest, "servo": sweep.servo, "bias": sweep.bias or (0.0,) * n}
        wrong = next((key for key, values in each.items() if len(values) != n), None)
        if names.count(sweep.name) > 1:
            yield f"two sweeps are called {sweep.name!r}"
        elif wrong:
            yield f"sweep {sweep.name}: {wrong} has {len(each[wrong])} values, expected one for each joint ({n})"
        elif not 0 <= sweep.joint < n:
            yield f"sweep {sweep.name}: joint is {sweep.joint}, expected 0 to {n - 1}"
        elif len(sweep.steps) < 2 or (np.diff(sweep.steps) <= 0).any():
            yield f"sweep {sweep.name}: its steps do not increase"
        elif any(not (sweep.stops[k] or sweep.servo[k]) for k in range(n) if k != sweep.joint):
            yield f"sweep {sweep.name}: one joint is held neither on a stop nor by its position loop"


def _of_poses(plan: SweepPlan, servoed: Ends, pressed: Ends, names: Sequence[str]) -> Iterator[str]:
    for number, pose in enumerate(plan.scout, start=1):
        yield from _beyond(f"scout pose {number}", np.array(pose), *servoed, names)
    for sweep in plan.sweeps:
        servo = np.array(sweep.servo)
        servo[sweep.joint] = True
        stop = np.where(np.array(sweep.stops) > 0, pressed[1], pressed[0])
        lower, upper = (np.where(servo, each, stop) for each in servoed)
        for what, step in (("first step", sweep.steps[0]), ("last step", sweep.steps[-1])):
            there = np.array(sweep.rest)
            there[sweep.joint] = step
            yield from _beyond(f"sweep {sweep.name}, {what}", there, lower, upper, names)


def _beyond(where: str, pose: Array, lower: Array, upper: Array, names: Sequence[str]) -> Iterator[str]:
    for k in np.flatnonzero((pose < lower - ROUNDING) | (pose > upper + ROUNDING)).tolist():
        yield f"{where}: {names[k]} is at {pose[k]:.4g} rad, expected {lower[k]:.4g} to {upper[k]:.4g} rad"


def _of_drives(plan: SweepPlan, planned: PlannedArm) -> Iterator[str]:
    if not 0 < plan.travel_acceleration <= FASTEST * (1 + ROUNDING):
        yield f"travel_acceleration is {plan.travel_acceleration:g} rad/s², expected at most {FASTEST:g}"
    fastest = max(planned.section.acceleration, SLOWEST)
    for sweep in plan.sweeps:
        if sweep.speed is not None:
            yield f"sweep {sweep.name} is a creep sweep, but this is a plan of readings at rest"
        if not 0 < sweep.acceleration <= fastest * (1 + ROUNDING):
            yield f"sweep {sweep.name}: acceleration is {sweep.acceleration:g} rad/s², expected at most {fastest:g}"
        yield from _of_bias(sweep, planned.limits, planned.arm.names)


def _of_bias(sweep: Sweep, limits: DriveLimits, names: Sequence[str]) -> Iterator[str]:
    for k, bias in enumerate(sweep.bias or ()):
        pressed = k != sweep.joint and not sweep.servo[k]
        most, side = limits.max_torque[k] * (1 + ROUNDING), sweep.stops[k]
        if abs(bias) > most:
            yield (
                f"sweep {sweep.name}: {names[k]} is pressed with {bias:g} N·m, expected at most "
                f"{limits.max_torque[k]:g} N·m"
            )
        elif bias * side < 0 or (bias and not pressed):
            yield f"sweep {sweep.name}: {names[k]} is pressed with {bias:g} N·m away from the stop that it rests on"
