"""Reasons for parameters without a value, one sentence each."""

import numpy as np

from calib.fit.sweep_readings import SweepReadings
from calib.records.records import PARAMETERS, Parameter
from gcomp.identify.global_fit import GlobalFit

WORDY = 6
"""Largest number of parameters that a reason names."""
WHERE_IT_HANGS = ": measure where the reference mass hangs (sweep.reference_point in the arm file)"
"""What fixes a gain that the readings with a mass leave open, as those of a single joint do."""


def missing_values(fit: GlobalFit, rows: SweepReadings) -> dict[tuple[str, Parameter], str]:
    """(joint, parameter) → reason, for each parameter without a value."""
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
        return f"these sweeps determine it to ± {2 * spread:.2g} only: gravity hardly acts on it in these poses"
    for sentence in fit.null_space:
        if name in sentence:
            if "common factor" in sentence and not any(rows.masses):
                return "no readings with a reference mass: only ratios of gains are determined"
            remedy = WHERE_IT_HANGS if "load_point" in sentence and name.startswith("gain") else ""
            if sentence.count(",") > WORDY:
                return f"not identifiable: the data fit equally well with other values{remedy}"
            return f"{sentence}{remedy}"
    return "the readings do not determine it"
