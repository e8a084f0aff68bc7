"""Why a parameter has no value, in a sentence for a person."""

import numpy as np

from calib.fit.sweep_readings import SweepReadings
from calib.records.records import PARAMETERS, Parameter
from gcomp.identify.global_fit import GlobalFit

WORDY = 6
"""Parameters that a reason names one by one."""


def reasons_of(fit: GlobalFit, rows: SweepReadings) -> dict[tuple[str, Parameter], str]:
    """Why each parameter without a value has none."""
    reasons: dict[tuple[str, Parameter], str] = {}
    lost = {name: found for name, found in zip(fit.names, fit.identifiable, strict=True) if not found}
    for name in (*lost, *fit.hopeless):
        family, _, joint = name.rstrip("]").partition("[")
        for parameter in PARAMETERS:
            if parameter == family:
                reasons[joint, parameter] = _reason(name, fit, rows)
    return reasons


def _reason(name: str, fit: GlobalFit, rows: SweepReadings) -> str:
    if name in fit.hopeless:
        spread = float(np.sqrt(fit.covariance_of(name)[0, 0]))
        return f"these sweeps would give it to ± {2 * spread:.2g} only: gravity hardly acts on it in these poses"
    for sentence in fit.null_space:
        if name in sentence:
            if "common factor" in sentence and not any(rows.masses):
                return "no readings with a reference mass: only ratios of gains are determined"
            others = sentence.count(",")
            if others > WORDY:
                return f"it can change together with {others} other parameters without changing any reading"
            return sentence
    return "the readings do not determine it"
