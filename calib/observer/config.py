"""Settings of the observer at rest, and constants that several of its parts or the observer in motion share.

Values from docs/theory.md, section 6, are marked §6; the simulations there support them. The others follow from the
reason given, and tests/campaigns/daemon_days.py bounds the result: time to find a drift, errors after recalibration,
payloads recognised, no write in quiet work.
"""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, FiniteFloat

from armlink.arm_file import Section

INITIAL_GAIN_STD = 5e-3
"""Standard deviation of a gain just installed: the accuracy asked of a calibration."""
INITIAL_OFFSET_STD = 0.05
"""Standard deviation of an offset just installed [N·m]: likewise."""
LONGEST_GAP = 0.05
"""A rest or a stretch of motion with samples missing for longer starts again [s]: 12 cycles at 250 Hz."""
AUDIT_ROWS = 10
"""Rows between tests while no alarm is open, each on the last `LONGEST_WINDOW` rows: finds drifts too small or too slow
for an alarm."""
LONGEST_WINDOW = 60
"""Rows kept for an ambiguous test and for the final estimate (§6: gain to 0.03–0.07 % on well-loaded joints); also rows
that show whether a gain can be told, and poses remembered."""
PLACE_SIZE = 0.2
"""Poses within this distance in every joint count as one pose, and rows of a joint as neighbours [rad]."""


@dataclass(frozen=True)
class WindowSizes:
    """Numbers of rows."""

    window: int
    """Of one test under an alarm."""
    audit: int
    """Between tests while there is no alarm."""
    longest: int
    """Kept for a test without an alarm, or for one that is ambiguous."""
    overlap: int = 0
    """Of a window that the next one has too."""
    at_a_place: int | None = None
    """Of one pose that count; None: all."""


NotNegative = Annotated[FiniteFloat, Field(ge=0)]
RowCount = Annotated[int, Field(ge=1)]


class ObserverConfig(Section):
    """Settings that an arm or its work may need otherwise: the keys of `daemon.observer` in its file."""

    still_band: NotNegative = 4e-3
    """The arm rests while no joint leaves this band [rad]. Over a rest of 0.4 s that is 0.01 rad/s on average, a fifth
    of the limit in §6, and it leaves room for a servo that hunts against friction; its jerks begin and end at rest, so
    that their torque averages out."""
    settle_time: NotNegative = 0.1
    """Rest before averaging begins [s]: several time constants of the torque sensor's filter."""
    average_time: NotNegative = 0.3
    """Averaging time [s]: 75 samples at 250 Hz reduce sensor noise by a factor of nine."""
    noise_share: NotNegative = 1e-3
    """Initial standard deviation of one row, as a share of rated torque: half of one sample's noise of 0.2 %."""
    alarm_gain: NotNegative = 0.01
    """Gain change that the CUSUM is tuned to (§6)."""
    alarm_offset: NotNegative = 0.2
    """Offset change that the CUSUM is tuned to [N·m] (§6)."""
    window: RowCount = 20
    """Rows of one test (§6): with 20 rows 98 % of the verdicts of 200 rows are reached, in 40 s of motion."""
    baseline_rows: RowCount = 120
    """Drift-free rows that drift is measured against: gravity model and discrepancy are adapted to them. Three minutes,
    in which a drift of 0.5 % an hour is 0.03 %."""
    position_std: NotNegative = 1e-3
    """Standard deviation of a position sensor's zero [rad]; marginalised like the model's error."""
    zero_wander: NotNegative = 3e-3
    """Most that a zero moves with temperature (standard deviation), as a share of rated torque: a sensor of class 0.15,
    three times worse than good ones, by 20 K. Where the arm's discrepancy is small, less is assumed."""
    tool_windows: RowCount = 60
    """Consecutive windows that find the same payload until it counts as a tool: half an hour of stops."""
    gain_std: NotNegative = 3e-3
    """A gain is written only if the rows determine it to this standard deviation: 0.3 % (§6)."""
    offset_std: NotNegative = 0.02
    """An offset is written only if its standard deviation is smaller [N·m] (§6)."""
    rest_between_writes: NotNegative = 60.0
    """At most one write per joint in this time [s] (T_min of §6)."""
