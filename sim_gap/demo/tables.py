"""The demo's tables in the terminal: estimates beside the truth."""

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from calib.creep.fit import CreepFit
from calib.creep.record import HEADINGS, determined_joints
from calib.fit.sensor_fit import SensorFit
from calib.records.records import Parameter
from calib.sweep.verify import Verification
from sim_gap.demo.bench import Bench, GravityCheck
from sim_gap.demo.result import DemoResult

SENSOR_DIGITS: dict[Parameter, int] = {"gain": 4, "offset": 3, "position_gain": 5}
"""Sensor parameters that the demo draws and finds, with the digits to show."""
CREEP_DIGITS = {"gain": 4, "offset": 3, "zero": 4, "coulomb": 3, "load": 3, "viscous": 3}
"""Families of the creep fit to show, with digits."""
ABSENT = "not observable"


def calibration_table(bench: Bench, fit: SensorFit) -> Table:
    """Estimates with 95 % intervals beside the truth, which was opened only for this table."""

    def cell(parameter: Parameter, digits: int, joint: int) -> str:
        value, true = fit.value(parameter)[joint], getattr(bench.truth, parameter)[joint]
        half = value - fit.ci95(parameter)[joint][0]
        estimate = ABSENT if np.isnan(value) else f"{value:.{digits}f} ± {half:.{digits}f}"
        return f"{estimate} ({true:.{digits}f})"

    rows = [[name, *(cell(*each, j) for each in SENSOR_DIGITS.items())] for j, name in enumerate(bench.link.names)]
    heads = ("joint", "torque gain", "torque offset [N·m]", "position gain")
    return _table("torque and position sensors: estimated ± 95 % (true)", heads, rows)


def creep_table(result: DemoResult, fit: CreepFit) -> Table:
    """The same of an arm without torque sensors."""
    truth = result.truth
    truths = {"gain": truth.gain, "zero": truth.position_offset, "coulomb": result.bench.simulated.true_friction}
    rows = [
        [name, *(f"{creep_cell(fit, family, j)} ({true[j]:.3f})" for family, true in truths.items())]
        for j, name in enumerate(result.names)
    ]
    heads = ("joint", *(HEADINGS[family] for family in truths))
    return _table("torque constants, zeros and friction: estimated ± 95 % (true)", heads, rows)


def verify_table(names: tuple[str, ...], check: Verification, gravity: GravityCheck) -> Table:
    """Model against sensor, and model against the plant's own gravity."""
    rows = []
    for j, name in enumerate(names):
        rms, largest = gravity.rms_error[j], gravity.max_torque[j]
        share = f"{rms / largest:.2%}" if largest > 1e-6 else "-"
        rows.append([name, f"{check.rms[j]:.4f}", f"{rms:.4f}", f"{largest:.2f}", share])
    title = f"gravity model: at {len(check.position)} poses of the arm; at {gravity.poses} against the truth"
    return _table(title, ("joint", "RMS to sensor [N·m]", "RMS to truth [N·m]", "largest torque [N·m]", "share"), rows)


def _table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=title)
    for column, head in enumerate(heads):
        table.add_column(head, justify="right" if column else "left")
    for row in rows:
        table.add_row(*row)
    return table


def creep_cell(fit: CreepFit, family: str, joint: int) -> str:
    """Estimate ± half of its 95 % interval."""
    if not determined_joints(fit, family)[joint]:
        return ABSENT
    digits = CREEP_DIGITS[family]
    return f"{fit.value(family)[joint]:.{digits}f} ± {1.96 * fit.std(family)[joint]:.{digits}f}"
