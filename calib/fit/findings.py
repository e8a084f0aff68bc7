"""Findings: effects in the readings that the sensor model does not have, in words."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.fit.refinement import Refined
from calib.fit.sweep_readings import SweepReadings
from calib.fit.unmodelled_effects import UnmodelledEffect, size_of
from calib.motion.encoder_check import stuck_bits
from gcomp.arrays import Array, Mask

Kind = Literal[
    "spring",
    "direction",
    "hysteresis",
    "nonlinear",
    "saturation",
    "drift",
    "eccentricity",
    "encoder",
    "outliers",
    "scatter",
    "contact",
]
OUTLIER = 6.0
"""Robust standard deviations of a joint's residuals from which a reading, or a sweep, is not one of the others
(docs/theory.md, 5.4)."""
SCATTER, MATERIAL_SCATTER = 3.0, 0.002
"""Scatter that counts as a finding: this factor to the samples' noise, and this share of rated torque. Held by
tests/campaigns/random_arms.py (none) and hard_cases.py (named)."""
HOLDING: tuple[Kind, ...] = ("direction", "hysteresis", "outliers", "contact")
"""Findings that the fit removes completely: with them removed the model holds."""


@dataclass(frozen=True, eq=False)
class FitFinding:
    """An effect in the readings that the sensor model does not have."""

    joint: str
    kind: Kind
    size: float
    """In `unit`; NaN if no single number describes it."""
    unit: str
    text: str
    """One sentence for the user."""

    @property
    def breaks_model(self) -> bool:
        """Whether the joint's values must not be used as they are."""
        return self.kind not in HOLDING


def effect_finding(
    names: tuple[str, ...], effect: UnmodelledEffect, coefficient: Array, refined: Refined, rated: Array
) -> FitFinding:
    name, gain = names[effect.joint], float(refined.fit.complete.gain[effect.joint]) or 1.0
    value = float(coefficient[0])
    if effect.id == "transmission.spring":
        text = (
            f"{name}: part of the torque is linear in position, {value / gain:+.3g} N·m/rad, and gravity "
            "does not explain it: does a cable or a spring cross the joint? This part is taken out; its "
            "pull at 0 rad counts as offset"
        )
        return FitFinding(name, "spring", value / gain, "N·m/rad", text)
    if effect.each_sweep:
        size = size_of(coefficient)
        text = (
            f"{name}: readings differ by {2 * size:.3g} N·m between the two directions of approach; this is taken out"
        )
        return FitFinding(name, "direction", size, "N·m", text)
    if effect.id == "torque.hysteresis":
        text = (
            f"{name}: the torque sensor lags by {abs(value):.3g} N·m behind changes of torque (hysteresis); "
            "this is taken out"
        )
        return FitFinding(name, "hysteresis", abs(value), "N·m", text)
    if effect.id == "torque.saturation":
        text = f"{name}: the torque sensor flattens beyond {effect.knee:.3g} N·m: does it saturate?"
        return FitFinding(name, "saturation", effect.knee, "N·m", text)
    if effect.id == "torque.drift":
        text = f"{name}: the torque reading drifts by {value * 3600:+.3g} N·m an hour: warm up, then sweep again"
        return FitFinding(name, "drift", value * 3600, "N·m/h", text)
    if effect.id == "position.eccentricity":
        size = float(np.hypot(*coefficient))
        text = f"{name}: the position reading is wrong by {size:.3g} rad once a turn: an eccentric encoder disc?"
        return FitFinding(name, "eccentricity", size, "rad", text)
    text = f"{name}: the torque sensor's gain changes with the load (by {2 * value / gain:+.2%} at the largest)"
    return FitFinding(name, "nonlinear", value / gain, "1", text)


def encoder_findings(names: tuple[str, ...], rows: SweepReadings) -> list[FitFinding]:
    """Findings of position sensors with a bit that never changes."""
    found = []
    for joint, bit, step in stuck_bits(rows.readings.position, rows.resolution, rows.target):
        text = (
            f"{names[joint]}: bit {bit} of the position reading ({step:.3g} rad) never changes: the encoder or its"
            " transmission is faulty; no result that uses this joint's position is valid"
        )
        found.append(FitFinding(names[joint], "encoder", step, "rad", text))
    return found


def outlier_findings(names: tuple[str, ...], rows: SweepReadings, outliers: Mask) -> list[FitFinding]:
    """Findings of outliers, by joint, with a likely cause."""
    found = []
    for joint in np.flatnonzero(outliers.any(axis=0)):
        at = np.flatnonzero(outliers[:, joint])
        series, angle = rows.readings.series[at], rows.readings.position[at, joint]
        places = ", ".join(f"{rows.sweeps[series[k]]} at {angle[k]:.3f} rad" for k in range(min(len(at), 4)))
        more = f" and {len(at) - 4} more" if len(at) > 4 else ""
        run = len(at) >= 2 and len(set(series.tolist())) == 1
        cause = (
            "did the joint touch something there, or did a joint at rest slip"
            if run
            else "was there a knock or a bad contact"
        )
        text = f"{names[joint]}: {len(at)} readings left out, {places}{more}: {cause}?"
        found.append(FitFinding(names[joint], "outliers", float(len(at)), "readings", text))
    return found


def scatter_findings(names: tuple[str, ...], refined: Refined, rated: Array, named: set[str]) -> list[FitFinding]:
    """Findings of joints whose readings scatter far more than their samples' noise, without a known cause."""
    linear, found = refined.linear, []
    rest = linear.residual * linear.sigma
    for joint, name in enumerate(names):
        here = linear.joint == joint
        if name in named or not here.any():
            continue
        rms = float(np.sqrt(np.mean(rest[here] ** 2)))
        if refined.factor[joint] > SCATTER and rms > MATERIAL_SCATTER * rated[joint]:
            text = (
                f"{name}: readings scatter by {rms:.3g} N·m, which is {refined.factor[joint]:.0f} times what their "
                "noise explains, and no known effect explains the rest: the model does not hold for this joint"
            )
            found.append(FitFinding(name, "scatter", rms, "N·m", text))
    return found
