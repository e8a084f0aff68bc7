"""Zeros of positions that are off by some tenths of a radian: a calibration lost, or another one in the model."""

from collections.abc import Sequence

import numpy as np

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.finding import Finding
from sim_gap.checks.mounting import as_loaded, body_at
from sim_gap.checks.rigid_fit import FEW, Motion, changed, fit_model, fit_rigid, rows_of
from sim_gap.model.rigid_body import RigidArm

STEP, STEPS = 0.1, 4
"""Angles that are tried, either way: their step [rad], and how many. The first is an effect of an arm."""
FIRST, LIKELY = 0.2, 0.2
"""Angle that is tried first, and the fall from which the others are."""
CLEAR = 0.4
"""Fall of the summed cost from which a zero is asked about; on recordings of sound real arms none reaches 0.12, on
those with a zero off by 0.2 to 0.3 rad that MuJoCo's inverse dynamics tell 0.7 and more."""


def find_small_zero(arm: RigidArm, motion: Motion, stated: Corrections, follows: Sequence[str]) -> list[Finding]:
    """A joint whose zero is off by an angle that explains more than a load at the tip and a mass on its own link do.

    Not the last joint's: a moment of its link does the same.
    """
    if stated.order or stated.joints:
        return []
    loaded, few = as_loaded(arm, motion), rows_of(motion, slice(None, None, FEW))
    start = fit_rigid(loaded, few).cost.sum()

    def fall_at(place: tuple[int, float]) -> float:
        return float(start - fit_rigid(loaded, _moved(few, *place)).cost.sum())

    kinds = ("zero", "sign", "units")
    free = [j for j in range(arm.n - 1) if not any(stated.states(kind, f"q_{j + 1}") for kind in kinds)]
    falls = {place: fall_at(place) for place in ((j, sign * FIRST) for j in free for sign in (1.0, -1.0))}
    likely = [place for place, fall in falls.items() if fall > LIKELY]
    falls |= {(j, k * STEP): fall_at((j, k * STEP)) for j, _ in likely for k in range(-STEPS, STEPS + 1)}
    j, angle = max(falls, key=falls.__getitem__, default=(0, 0.0))
    fall = falls.get((j, angle), 0.0)
    if fall < CLEAR or abs(angle) < 1.5 * STEP:
        return []
    model = loaded.carried(motion.q, motion.v, motion.a)
    mass = fit_model(model + body_at(loaded, motion, j)[1], motion).cost.sum()
    if fit_rigid(loaded, _moved(motion, j, angle)).cost.sum() > mass:
        return []
    names = [name for name in ("q", *follows) if name != "dq"]
    option = "--zero " + ",".join(f"{name}_{j + 1}={angle:.2f}" for name in names) + f", or q_{j + 1}=0 if it is right"
    evidence = (
        f"may have its zero off by about {angle:+.2f} rad: then the logarithm of what is left falls by {fall:.1f}"
    )
    return [Finding("zero", "q", arm.names[j], evidence, option, False, fall)]


def _moved(motion: Motion, joint: int, angle: float) -> Motion:
    shift: Array = np.zeros(motion.q.shape[1])
    shift[joint] = angle
    return changed(motion, q=motion.q + shift)
