"""Zeros of positions that are off by some tenths of a radian: a calibration lost, or another one in the model."""

from collections.abc import Sequence
from dataclasses import replace

from scipy.optimize import minimize_scalar

from armlink.recording.corrections import Corrections
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.mounting import body_at, find_load, find_mounting
from sim_gap.checks.rigid_fit import FEW, ChannelMotion, fit_model, fit_rigid, rows_of
from sim_gap.model.rigid_body import RigidArm

STEP, STEPS = 0.1, 4
"""Angles that are tried, either way: their step [rad], and how many."""
LEAST = 0.15
"""Smallest angle that is asked about [rad]; a smaller one is an effect of an arm."""
FIRST, LIKELY = 0.2, 0.2
"""Angle that is tried first, and the fall from which the others are."""
CLEAR = 0.4
"""Fall of the summed cost from which a zero is asked about; on recordings of sound real arms none reaches 0.12, on
those with a zero off by 0.2 to 0.3 rad that MuJoCo's inverse dynamics tell 0.7 and more."""


def find_small_zero(
    arm: RigidArm, motion: ChannelMotion, stated: Corrections, follows: Sequence[str]
) -> list[RecordingFinding]:
    """A joint whose zero is off by an angle that explains more than a load at the tip and a mass on its own link do.

    Not the last joint's: a moment of its link does the same. A tilt of the base takes its part of the second's.
    """
    if stated.order or stated.joints:
        return []
    loaded, few = _as_it_is(arm, motion), rows_of(motion, slice(None, None, FEW))
    start = fit_rigid(loaded, few).cost.sum()
    kinds = ("zero", "sign", "units")
    free = [j for j in range(arm.n - 1) if not any(stated.states(kind, f"q_{j + 1}") for kind in kinds)]
    likely = [j for j in free if start - min(_cost(loaded, few, j, angle) for angle in (FIRST, -FIRST)) > LIKELY]
    if not likely:
        return []
    cost, j, angle = min(least_cost(loaded, few, j) for j in likely)
    if start - cost < CLEAR:
        return []
    for _ in range(3):  # fitted to wrong angles, tilt and load take their part of them
        right = _as_it_is(arm, _moved(motion, j, angle))
        cost, _, angle = least_cost(right, few, j)
    fall = float(start - cost)
    model = loaded.carried(motion.q, motion.v, motion.a)
    mass = fit_model(model + body_at(loaded, motion, j)[1], motion).cost.sum()
    if abs(angle) < LEAST or fall < CLEAR or _cost(right, motion, j, angle) > mass:
        return []
    names = [name for name in ("q", *follows) if name != "dq"]
    option = "--zero " + ",".join(f"{name}_{j + 1}={angle:.2f}" for name in names) + f", or q_{j + 1}=0 if it is right"
    evidence = f"may have its zero off by about {angle:+.2f} rad: with that the model explains much more of the torque"
    return [RecordingFinding("zero", "q", arm.names[j], evidence, option, False, fall)]


def _as_it_is(arm: RigidArm, motion: ChannelMotion) -> RigidArm:
    return find_load(find_mounting(arm, motion), motion)


def least_cost(arm: RigidArm, motion: ChannelMotion, joint: int) -> tuple[float, int, float]:
    """Least summed cost with the zero of a joint off by a small angle, the joint, and that angle [rad]."""
    angles = [k * STEP for k in range(-STEPS, STEPS + 1)]
    near = min(angles, key=lambda angle: _cost(arm, motion, joint, angle))
    found = minimize_scalar(
        lambda angle: _cost(arm, motion, joint, angle),
        bounds=(near - STEP, near + STEP),
        method="bounded",
        options={"xatol": 0.1 * STEP},
    )
    return float(found.fun), joint, float(found.x)


def _cost(arm: RigidArm, motion: ChannelMotion, joint: int, angle: float) -> float:
    """Summed cost with the zero of a joint off by an angle."""
    return float(fit_rigid(arm, _moved(motion, joint, angle)).cost.sum())


def _moved(motion: ChannelMotion, joint: int, angle: float) -> ChannelMotion:
    q = motion.q.copy()
    q[:, joint] += angle
    return replace(motion, q=q)
