"""Positions against the ranges that the model's joints have: an arm cannot be where its model says that it cannot."""

import numpy as np

from armlink.recording.corrections import Corrections
from armlink.recording.recording import Recording
from sim_gap.checks.finding import Finding
from sim_gap.model.rigid_body import RigidArm

BEYOND = 0.2
"""Distance beyond the end of its range from which a joint is not there [rad]; zeros and soft limits differ by less."""


def find_beyond_range(arm: RigidArm, recording: Recording, stated: Corrections) -> list[Finding]:
    """Joints that leave the model's range, unless the user stated sign, zero, unit or order of their positions."""
    found = []
    for j, (low, high) in enumerate(arm.range):
        q, column = recording.position[:, j], f"q_{j + 1}"
        least, most = float(np.nanmin(q)), float(np.nanmax(q))
        settled = stated.joints or stated.columns or any(stated.states(k, column) for k in ("sign", "zero", "units"))
        if settled or (least > low - BEYOND and most < high + BEYOND):
            continue
        evidence = (
            f"runs from {least:.2f} to {most:.2f} rad, the model's joint from {low:.2f} to {high:.2f} rad: another "
            "zero, sign, unit or joint?"
        )
        option = (
            f"--zero {column}=ANGLE, --sign {column}=-1 or --map, or --zero {column}=0 if the model's range is wrong"
        )
        found.append(Finding("zero", "q", arm.names[j], evidence, option, False))
    return found
