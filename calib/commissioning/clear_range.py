"""Joint ranges without collision, for an arm that touches itself or its surroundings within its model's limits."""

from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import model_arm
from calib.plan.collisions import Geometry, check_plan
from calib.plan.rough_gravity import guess_of_file
from calib.plan.sweep_plan import plan_sweep
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.errors import GcompError

WIDTH_SHARES = (0.8, 0.65, 0.5, 0.4, 0.3, 0.22, 0.16)
"""Widths of the range that are tried, as shares of the model's."""
SKETCH, PROOF = 40, 400
"""Poses at which a range is looked at while choosing and in the end; half of them are corners."""


@dataclass(frozen=True, eq=False)
class ClearRange:
    """A part of the joint ranges without collision at every pose that was looked at."""

    lower: Array
    """(n,) [rad]"""
    upper: Array
    """(n,) [rad]"""
    reason: str
    """Why the model's limits are not kept."""


def find_clear_range(arm_file: ArmFile) -> ClearRange | None:
    """A clear range for an arm whose sweeps would collide within the model's limits; None where they would not.

    Raises BadInput or Refused as planning does where nothing narrower helps.
    """
    geometry = Geometry(arm_file)
    problem = _problem(arm_file)
    if problem is None:
        return None
    if geometry.model.ngeom == 0:
        raise problem
    arm = model_arm(arm_file).arm
    generator = np.random.default_rng(0)
    centres = np.concatenate([[(arm.lower + arm.upper) / 2], generator.uniform(arm.lower, arm.upper, (80, arm.n))])
    centres = centres[geometry.free(centres)]
    for share in WIDTH_SHARES:
        boxes = [_box(arm, centre, share) for centre in centres]
        clear = [box for box in boxes if geometry.free(_poses(box, SKETCH, generator)).all()]
        for low, high in clear:
            if geometry.free(_poses((low, high), PROOF, generator)).all():
                return ClearRange(low, high, str(problem).removeprefix(f"{arm_file.name}: "))
    raise problem


def _problem(arm_file: ArmFile) -> Exception | None:
    """The error that planning the sweeps ends with, None if it succeeds."""
    from armlink.errors import ArmlinkError

    guess = guess_of_file(arm_file)
    try:
        for seed in (0, 1):  # plans that must be clear for the model's own limits to be kept
            check_plan(arm_file, plan_sweep(arm_file, seed=seed))
            check_plan(arm_file, plan_sweep(arm_file, guess, seed=seed))
    except (ArmlinkError, GcompError) as error:
        return error
    return None


def _box(arm: Arm, centre: Array, share: float) -> tuple[Array, Array]:
    """`share` of the range about `centre`, moved within the limits."""
    half = share * (arm.upper - arm.lower) / 2
    middle = np.clip(centre, arm.lower + half, arm.upper - half)
    return middle - half, middle + half


def _poses(box: tuple[Array, Array], count: int, generator: np.random.Generator) -> Array:
    low, high = box
    shares = generator.random((count, len(low)))
    shares[: count // 2] = np.round(shares[: count // 2])
    return low + shares * (high - low)
