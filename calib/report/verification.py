"""Report of a verification as one HTML page, with the paper's Figure 6."""

from pathlib import Path

from armlink.arm_file import ArmFile
from calib.records.records import CalibrationRecord, GravityRecord
from calib.report.figures import verify_figure
from calib.report.page import ReportSection, paragraph, render, verdict_line
from calib.report.tables import ReportTable
from calib.sweep.verify import Verification


def write_report(
    result: Verification, arm: ArmFile, gravity: GravityRecord, calibration: CalibrationRecord | None, path: Path
) -> None:
    """Write one self-contained HTML file; raises OSError."""
    verdict = "passed" if result.passed else "not passed"
    sensors = "the calibration in the drives" if calibration is None else f"calibration record {calibration.id}"
    skipped = f" {result.skipped} poses were skipped, since the drives cannot reach them." if result.skipped else ""
    html = verdict_line(verdict) + paragraph(
        f"Gravity record {gravity.id} compared with the torque sensors with {sensors}, at "
        f"{len(result.sensor)} random poses that were used for no fit.{skipped}"
    )
    header = ("joint", "RMS [N·m]", "allowed RMS", "largest [N·m]", "standard deviation of the model", "largest torque")
    numbers = (
        result.rms,
        result.tolerance,
        result.max_error,
        result.model_std.mean(axis=0),
        abs(result.model).max(axis=0),
    )
    rows = [[name, *(f"{column[joint]:.4f}" for column in numbers)] for joint, name in enumerate(result.names)]
    section = ReportSection(
        "Model against sensor (as Figure 6 of Ma and Hollerbach)",
        html,
        [verify_figure(result)],
        [ReportTable(header, rows)],
    )
    title = f"Verification: {arm.name} {arm.serial}"
    render(
        path,
        title,
        [section],
        f"gravity record {gravity.id} of {gravity.created:%Y-%m-%d %H:%M} UTC, {gravity.software}",
    )
