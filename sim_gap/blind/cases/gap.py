"""The held-out gap of a recording against the nominal model, computed independently of the diagnosis."""

from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.cases.arms import Arm
from sim_gap.blind.plant.rigid_body import compiled, inverse

RATE = 250.0
BAND_HZ = 6.0
SMOOTH_SPEED = 0.02
"""Speed over which nominal friction changes sign [rad/s]."""
VISIBLE_RATIO, VISIBLE_LEAST = 3.0, 0.08
"""Least factor on some held-out RMS, and least increase of it [N·m], by a visible effect."""
MOVING = 0.03
"""Motor channels count only above this speed [rad/s]: at rest friction is undetermined."""


def gap(arm: Arm, columns: dict[str, Array]) -> dict[str, list[float]]:
    """RMS [N·m] per joint of `tau`, `tau_motor` and `tau_cmd` against the nominal model, below 6 Hz."""
    from scipy.signal import butter, sosfiltfilt

    t = np.arange(columns["t"][0], columns["t"][-1], 1.0 / RATE)
    even = {k: _even(t, columns["t"], columns[k]) for k in ("q", "tau", "tau_motor", "tau_cmd")}
    low = butter(4, BAND_HZ, fs=RATE, output="sos")
    q = sosfiltfilt(butter(4, 15.0, fs=RATE, output="sos"), even["q"], axis=0)
    v = np.gradient(q, 1.0 / RATE, axis=0)
    a = np.gradient(v, 1.0 / RATE, axis=0)
    motor = inverse(compiled(arm), q, v, a)
    link = motor - arm.armature * a
    motor = motor + arm.damping * v + arm.frictionloss * np.tanh(v / SMOOTH_SPEED)
    out = {}
    for channel, model in (("tau", link), ("tau_motor", motor), ("tau_cmd", motor)):
        rest = sosfiltfilt(low, even[channel] - model, axis=0)[100:-100]
        counts = (np.abs(v[100:-100]) > MOVING) if channel != "tau" else np.ones(rest.shape, bool)
        out[channel] = [
            float(np.sqrt((x[c] ** 2).mean())) if c.any() else 0.0 for x, c in zip(rest.T, counts.T, strict=True)
        ]
    return out


def largest_fall(before: dict[str, list[float]], after: dict[str, list[float]]) -> dict[str, Any]:
    """Channel and joint at which the effect's absence lowers the gap most, with both values and the shrink."""
    falls = [
        (b - a, channel, j, b, a)
        for channel in before
        for j, (b, a) in enumerate(zip(before[channel], after[channel], strict=True))
    ]
    _, channel, j, b, a = max(falls)
    return {"channel": channel, "joint": f"joint_{j + 1}", "before": b, "after": a, "shrink": 1.0 - a / max(b, 1e-9)}


def visible(fall: dict[str, Any]) -> bool:
    """Whether the gap caused by an effect exceeds that of every arm clearly."""
    return bool(fall["before"] > VISIBLE_RATIO * fall["after"] and fall["before"] - fall["after"] > VISIBLE_LEAST)


def _even(t: Array, own: Array, values: Array) -> Array:
    return np.column_stack([np.interp(t, own, column) for column in values.T])
