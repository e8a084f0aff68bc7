"""Tables of numbers as texts, the same on a page and in a terminal; needs nothing of what draws a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from calib.fit.calibration import FittedCalibration, interval_text
from calib.fit.creep_fit import CreepFit

SENSOR_HEADINGS = {"gain": "gain", "offset": "offset [N·m]", "position_gain": "position gain"}
"""Parameters of torque and position sensors, as people read them."""
CREEP_HEADINGS = {
    "gain": "reading per N·m (1/k)",
    "offset": "offset [N·m]",
    "position_offset": "zero [rad]",
    "coulomb": "Coulomb friction [N·m]",
    "load": "friction per load",
    "viscous": "viscous [N·m·s/rad]",
}
"""The same of drives whose torque is a motor current."""


@dataclass(frozen=True)
class ReportTable:
    """A table with a caption; numbers are formatted already."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    texts: int = field(default=1, kw_only=True)
    """Number of text columns, from the left; the others are numbers, aligned right."""


def columns_of(fit: FittedCalibration) -> dict[str, tuple[Any, Any]]:
    """Heading → (value, half of its 95 % interval), (n,) each, of what people want to know of a calibration."""
    headings = CREEP_HEADINGS if isinstance(fit, CreepFit) else SENSOR_HEADINGS
    return {heading: (fit.value(name), fit.half95(name)) for name, heading in headings.items()}


def interval_table(names: Sequence[str], columns: Mapping[str, tuple[Any, Any]], caption: str = "") -> ReportTable:
    """A row a joint; `columns` maps heading to (value, half of its 95 % interval), (n,) each."""
    rows = [[name, *(interval_text(v[j], half[j]) for v, half in columns.values())] for j, name in enumerate(names)]
    return ReportTable(("joint", *columns), rows, caption)
