"""Averages of a creep over bins of position, one direction at a time.

A bin is averaged with a Hann window over position, which suppresses ripple whose period is at most half its width. Only
samples count in which the joint has moved on in its direction: at a reversal friction takes a short way to turn round.
"""

from collections.abc import Sequence

import numpy as np

from armlink.link.types import Sample
from calib.motion.static_reading import StaticReading, stack
from gcomp.arrays import Array


def bin_readings(
    samples: Sequence[Sample], joint: int, side: int, middles: Array, temperature: Array | None = None
) -> list[StaticReading | None]:
    """One reading per bin about `middles` (B,) [rad] of a creep of `joint` in direction `side`; None where it has none.

    The reading's `speed` is that of the joint within the bin.
    """
    position, torque, t = stack(samples, "position"), stack(samples, "torque"), np.array([each.t for each in samples])
    whole = np.isfinite(position).all(axis=1) & np.isfinite(torque[:, joint])
    position, torque, t = position[whole], torque[whole], t[whole]
    width = float(middles[1] - middles[0])
    own = position[:, joint]
    return [
        _reading(position, torque, t, np.abs(own - middle) < width / 2, middle, width, joint, side, temperature)
        for middle in middles
    ]


def _reading(
    position: Array, torque: Array, t: Array, inside: Array, middle: float, width: float, joint: int, side: int,
    temperature: Array | None,
) -> StaticReading | None:  # fmt: skip
    if inside.sum() < 5:  # too few for a mean
        return None
    q, v, when = position[inside], torque[inside], t[inside]
    weight = 1 + np.cos(2 * np.pi * (q[:, joint] - middle) / width)
    weight /= weight.sum()
    centred = when - when.mean()
    speed = float(centred @ q[:, joint]) / max(float(centred @ centred), 1e-12)
    if speed * side <= 0:
        return None
    mean_q, mean_v = weight @ q, weight @ v
    return StaticReading.of(
        float(when.mean()),
        mean_q,
        mean_v,
        count=int(inside.sum()),
        settled=True,
        position_std=np.sqrt(np.maximum(weight @ (q - mean_q) ** 2, 0.0)),
        torque_std=np.sqrt(np.maximum(weight @ (v - mean_v) ** 2, 0.0)),
        motor_torque=mean_v,
        speed=abs(speed),
        temperature=temperature,
    )
