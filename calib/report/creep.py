"""Report of a calibration by creep sweeps as one HTML page: the drives' values, the sweeps, what disturbed them."""

from pathlib import Path

from calib.creep.fit import QUANTILE, CreepFit
from calib.creep.record import HEADINGS, determined_values, missing
from calib.records.records import CalibrationRecord
from calib.report.figures import creep_figure
from calib.report.page import ReportSection, bullets, paragraph, paragraphs, render
from calib.report.tables import interval_table

HOW = "Half the sum of both ways of a creep, up (▸) and down (◂), is gravity, half the difference friction."


def sections(fit: CreepFit) -> list[ReportSection]:
    """The sweeps, for a part of another report."""
    return [ReportSection("Creep sweeps", paragraph(HOW) + paragraphs(fit.findings), [creep_figure(fit)])]


def write_report(fit: CreepFit, record: CalibrationRecord, contacts: list[str], path: Path) -> None:
    """Write one self-contained HTML file; raises OSError."""
    columns = {title: (determined_values(fit, key), QUANTILE * fit.std(key)) for key, title in HEADINGS.items()}
    values = interval_table(fit.names, columns, "Estimates ± half of the 95 % interval.")
    unknown = (f"{joint} {parameter}: {reason}" for (joint, parameter), reason in missing(fit).items())
    drives = ReportSection("Drives", bullets([*unknown, *contacts]), (), [values])
    title = f"Calibration {record.id}: {record.arm} {record.serial}"
    render(path, title, [drives, *sections(fit)], f"{record.created:%Y-%m-%d %H:%M} UTC, {record.software}")
