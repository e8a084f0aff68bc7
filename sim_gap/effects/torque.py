"""Errors of a joint torque sensor: linear ones, distortions by its own torque or another joint's, and delay.

They show in `tau` against the model, and negated in motor against `tau`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import (
    CUT_OFF,
    NEAR_ONE,
    InverseEffect,
    Plausibility,
    SearchHints,
    Shape,
    Signature,
    Starts,
    delay_effect,
    exceeded_levels,
)
from sim_gap.residuals.preprocess import PreparedSignals

GRADUAL = (0.25, 0.75, 1.25, 1.75)
"""Half widths of the plays of a hysteresis that sets in gradually, as in strain gauges, as shares of their mean."""


def largest_torque(signals: Sequence[PreparedSignals], joint: int) -> float:
    """Largest absolute model torque of a joint but for a fiftieth of the time [N·m]."""
    return float(np.quantile(np.concatenate([np.abs(s.model[:, joint]) for s in signals]), 0.98))


def _other_joints(signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
    return tuple((float(source + 1),) for source in range(signals[0].n) if source != place)


def _distorted(distort: Callable[[Array, Shape], Array]) -> Signature:
    """Reading less true torque, `distort(torque (K,), shape)`; the shape begins with a level."""
    return Signature.at_sensor(lambda s, joint, shape: distort(s.passed_on[:, joint], shape), side="distortion")


def _shares(*shares: float) -> Starts:
    """Starting levels as shares of the joint's usual largest torque."""
    return lambda signals, place: tuple((share * largest_torque(signals, place),) for share in shares)


def _stays_behind(torque: Array, shape: Shape) -> Array:
    """Reading less true torque with hysteresis: one play, or if the shape says so several of growing width."""
    shares = GRADUAL if is_gradual(shape) else (1.0,)
    return np.asarray(np.mean([play(torque, share * shape[0]) for share in shares], axis=0) - torque)


def is_gradual(shape: Shape) -> bool:
    return len(shape) > 1


def _abrupt_and_gradual(shape: Shape) -> tuple[Shape, ...]:
    return (shape[:1], (shape[0], float(len(GRADUAL))))


def play(x: Array, half: float) -> Array:
    """Output of a play (backlash operator) of half width `half` that starts in its middle, (K,)."""
    steps = np.diff(x)
    turns = np.concatenate([[0], 1 + np.flatnonzero(steps[1:] * steps[:-1] <= 0.0), [len(x) - 1]])
    at, before = float(x[0]), []
    for value in x[turns[1:]].tolist():  # within a run in one direction the output follows from its start
        before.append(at)
        at = min(max(at, value - half), value + half)
    start = np.concatenate([x[:1], np.repeat(before, np.diff(turns))])
    return np.asarray(np.clip(start, x - half, x + half))


def _delayed(signals: PreparedSignals, joint: int, shape: Shape) -> Array:
    torque = signals.model[:, joint]
    return np.asarray(np.interp(signals.t - shape[0], signals.t, torque) - torque)


EFFECTS = (
    InverseEffect(  # without a sensor, an offset of the motor's torque
        "torque.offset",
        Signature.at_sensor(lambda s, _joint, _shape: np.ones(len(s.t)), "any"),
        # of a joint that went one way only, friction is the likelier cause: every gear rubs
        Plausibility(prior_penalty=2, background_std=0.02, background_nm=True),
    ),
    InverseEffect(
        "torque.gain",
        Signature.at_sensor(lambda s, joint, _shape: s.sensed[:, joint]),
        Plausibility(prior_penalty=0, background_std=0.002, bounds=(-0.5, 1.0)),
        parameters_of=lambda c, _shape, _: 1.0 + c,
    ),
    InverseEffect("torque.drift", Signature.at_sensor(lambda s, _joint, _shape: s.t), needs=("torque.offset",)),
    InverseEffect(
        "torque.crosstalk",
        Signature.at_sensor(lambda s, _joint, shape: s.model[:, int(shape[0]) - 1], side="distortion"),
        Plausibility(bounds=(-0.5, 0.5)),
        SearchHints(shapes_for=_other_joints, discrete=frozenset({0})),
        parameters_of=lambda c, shape, _: [c[0], shape[0]],
    ),
    InverseEffect(  # the width is the deviation after a long way
        "torque.hysteresis",
        _distorted(_stays_behind),
        Plausibility(background_std=0.02, bounds=NEAR_ONE),  # what is not known of its form
        SearchHints(
            shapes_for=_shares(0.01, 0.03, 0.06, 0.12, 0.25), discrete=frozenset({1}), forms=_abrupt_and_gradual
        ),
        parameters_of=lambda c, shape, _: c * shape[0],
    ),
    InverseEffect(  # the width is what is lost beyond the band, whose edges an offset moves
        "torque.deadband",
        _distorted(lambda torque, shape: -np.clip(torque, -shape[0], shape[0])),
        replace(CUT_OFF, background_std=lambda shape: 0.02 / shape[0], background_nm=True),
        SearchHints(shapes_for=_shares(0.02, 0.05, 0.1, 0.2, 0.4, 0.8)),
        parameters_of=lambda c, shape, _: c * shape[0],
    ),
    InverseEffect(
        "torque.saturation",
        _distorted(lambda torque, shape: np.clip(torque, -shape[0], shape[0]) - torque),
        CUT_OFF,
        SearchHints(shapes_for=exceeded_levels(lambda s, joint: s.model[:, joint])),
        parameters_of=lambda _, shape, _beneath: [shape[0]],
    ),
    delay_effect("timing.delay", Signature.at_sensor(_delayed, "any", "distortion"), 0.005, 0.1),
)
