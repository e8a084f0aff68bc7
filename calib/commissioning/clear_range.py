"""Joint ranges without collision, for an arm that touches itself or its surroundings within its model's limits."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from armlink.arm_file import ArmFile
from calib.arm.kinematics import model_arm, model_chain
from calib.plan.collisions import Geometry, check_plan
from calib.plan.rough_gravity import guess_of_file
from calib.plan.sweep_plan import plan_sweep
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.errors import GcompError

WIDTH_SHARES = (0.8, 0.65, 0.5, 0.4, 0.3, 0.22, 0.16)
"""Widths of the range that are tried, as shares of the model's."""
CENTRES = 80
"""Drawn poses about which a range is looked for, besides the middle of the joints' and the model's own pose."""
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


def clear_ranges(arm_file: ArmFile, problem: Exception) -> Iterator[ClearRange]:
    """Ranges without collision for an arm whose sweeps end in `problem` within its model's limits, widest first.

    One of each width; a later one is for those whose sweeps collide all the same, between the poses looked at here.
    """
    geometry = Geometry(arm_file)
    if geometry.model.ngeom == 0:
        return
    placed, generator = model_chain(arm_file), np.random.default_rng(0)
    arm = model_arm(arm_file, placed).arm
    own = np.clip(placed.reference, arm.lower, arm.upper)
    drawn = generator.uniform(arm.lower, arm.upper, (CENTRES, arm.n))
    centres = np.concatenate([[(arm.lower + arm.upper) / 2, own], drawn])
    centres = centres[geometry.free(centres)]
    reason = str(problem).removeprefix(f"{arm_file.name}: ").partition(": narrow")[0]
    for share in WIDTH_SHARES:
        boxes = [_box(arm, centre, share) for centre in centres]
        for low, high in boxes:
            sketched = geometry.free(_poses((low, high), SKETCH, generator)).all()
            if sketched and geometry.free(_poses((low, high), PROOF, generator)).all():
                yield ClearRange(low, high, reason)
                break


def sweep_problem(arm_file: ArmFile) -> Exception | None:
    """The error that planning the sweeps ends with, None if it succeeds."""
    from armlink.errors import ArmlinkError

    guess = guess_of_file(arm_file)
    try:
        for seed in (0, 1):  # plans that must be clear for a range to be kept
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
