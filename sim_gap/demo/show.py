"""Terminal output of the demo: tables and one-line findings."""

import numpy as np
from rich.table import Table

from calib.fit.sensor_fit import SensorFit
from calib.sweep.verify import Verification
from sim_gap.attribution.diagnosis import Diagnosis
from sim_gap.demo.bench import Bench, GravityCheck
from sim_gap.demo.drift import Drift
from sim_gap.demo.summary import SHOWN
from sim_gap.report.effect_text import sentence


def calibration_table(bench: Bench, fit: SensorFit) -> Table:
    """Estimates with 95 % intervals beside the truth, which was opened only for this table."""
    table = Table(title="torque and position sensors: estimated ± 95 % (true)")
    for column in ("joint", "torque gain", "torque offset [N·m]", "position gain"):
        table.add_column(column, justify="left" if column == "joint" else "right")
    for j, name in enumerate(bench.link.names):
        cells = []
        for parameter, digits in SHOWN:
            value, (low, _) = fit.value(parameter)[j], fit.ci95(parameter)[j]
            true = getattr(bench.truth, parameter)[j]
            cells.append(
                f"not observable ({true:.{digits}f})"
                if np.isnan(value)
                else f"{value:.{digits}f} ± {value - low:.{digits}f} ({true:.{digits}f})"
            )
        table.add_row(name, *cells)
    return table


def verify_table(names: tuple[str, ...], check: Verification, gravity: GravityCheck) -> Table:
    """Model against sensor, and model against the plant's own gravity."""
    table = Table(
        title=f"gravity model: at {len(check.position)} poses of the arm; at {gravity.poses} against the truth"
    )
    for column in ("joint", "RMS to sensor [N·m]", "RMS to truth [N·m]", "largest torque [N·m]", "share"):
        table.add_column(column, justify="left" if column == "joint" else "right")
    for j, name in enumerate(names):
        rms, largest = gravity.rms_error[j], gravity.max_torque[j]
        share = f"{rms / largest:.2%}" if largest > 1e-6 else "-"
        table.add_row(name, f"{check.rms[j]:.4f}", f"{rms:.4f}", f"{largest:.2f}", share)
    return table


def drift_line(names: tuple[str, ...], drift: Drift) -> str:
    """Outcome of the drift, in a sentence."""
    name = names[drift.joint]
    what = f"{name} drifted by {drift.gain - 1:+.0%} gain and {drift.offset:+.2f} N·m"
    if drift.detected is None:
        return f"{what}: not detected"
    seen = f"{what}: noticed after {drift.detected - drift.began:.1f} s"
    if drift.recalibrated is None:
        return f"{seen}, not recalibrated"
    gain, offset = drift.error_after
    return (
        f"{seen}, recalibrated by itself after {drift.recalibrated - drift.began:.0f} s of work;"
        f" error now {gain:+.2%} and {offset:+.3f} N·m"
    )


def gap_line(answer: Diagnosis) -> str:
    """The diagnosis in a sentence."""
    return sentence(answer)
