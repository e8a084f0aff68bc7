"""Settings and constants of the observer at rest, with units and the sources of their values; some hold in motion.

Values from docs/theory.md, section 6, are marked §6; the simulations there support them. The others follow from the
reason given, and tests/campaigns/daemon_days.py bounds the result: time to find a drift, errors after recalibration,
payloads recognised, no write in quiet work.
"""

from dataclasses import dataclass
from typing import Literal

Policy = Literal["observe", "propose", "apply"]
"""Treatment of a drift: an event only, a proposal, or a new record written to the controller."""


class ObserverConstants:
    """Thresholds that no arm needs otherwise."""

    gap_time = 0.05
    """A rest with readings missing for longer starts again [s]: 12 cycles at 250 Hz."""
    new_pose = 0.05
    """A stop counts as another one once some joint has moved this far [rad]: a long rest is one row."""
    noise_rows = 5.0
    """Rows that the initial standard deviation counts for; it is then measured from the halves of each average."""
    noise_memory = 200.0
    """Rows that the measured standard deviation is averaged over: known within 5 % by then."""
    drift_gain = 1e-4
    """Random walk of the gain per accepted row (§6): steady-state √(q σ/τ_rms) is 0.05 % for a joint loaded with
    10 N·m."""
    drift_offset = 2e-3
    """Random walk of the offset per accepted row [N·m] (§6): steady-state √(q σ) is 0.01 N·m at σ = 0.05 N·m."""
    initial_gain_std = 5e-3
    """Standard deviation of a gain just installed: the accuracy asked of a calibration."""
    initial_offset_std = 0.05
    """Standard deviation of an offset just installed [N·m]: likewise."""
    outlier = 10.8
    """A row is rejected by the filter if its squared innovation over the variance is larger: noise exceeds this χ²,
    with 1 degree of freedom, once in 1000 (§6)."""
    outliers_in_a_row = 3
    """This many rejected rows in succession are an event, not outliers (§6)."""
    place_size = 0.2
    """Poses within this distance in every joint count as one pose [rad]."""
    place_rows = 3
    """Rows of one pose that the filter and a window take: a repeated pose adds no information."""
    place_memory = 20
    """Rows that the mean residual of a pose is made of; the mean's error, σ/√20, is small against an alarm."""
    alarm_threshold = 10.0
    """Log-likelihood ratio (§6): one false alarm in 1.1e4 rows of a seven-joint arm, which only starts a test."""
    audit_rows = 10
    """Rows between tests while no alarm is open, each on the last `longest_window` rows: finds drifts too small or
    too slow for an alarm."""
    longest_window = 60
    """Rows kept for an ambiguous test and for the final estimate (§6: gain to 0.03–0.07 % on well-loaded joints);
    also rows that show whether a gain can be told, and poses remembered."""
    evidence = 10.0
    """BIC difference that counts as decided ("very strong") (§6)."""
    misfit = 4.0
    """(χ² − dof)/√(2 dof) above which no entry explains the window (§6)."""
    patience = 120
    """Repeated poses after an alarm, six windows' worth, after which the test is given up as undecided."""
    discrepancy_share = 5e-4
    """Discrepancy of the gravity model expected before the first row, as a share of rated torque; if the calibration
    says how large it is, that counts."""
    significance = 5.0
    """A change is written only if it is this many standard deviations (§6)."""
    agreement = 13.8
    """Two disjoint windows agree if the χ² of their difference (gain, offset) is smaller: noise exceeds it, with
    2 degrees of freedom, once in 1000 (§6)."""
    lever_share = 0.3
    """A gain is written only if gravity's lever Γ on the joint reached this share of g in the window (§6)."""
    common_joints = 3
    """If this many joints drift by the same factor, suspect gravity, payload or supply voltage, and write none (§6)."""


@dataclass(frozen=True)
class ObserverConfig(ObserverConstants):
    """Settings that an arm or its work may need otherwise: the keys of `daemon.observer` in its file."""

    still_band: float = 4e-3
    """The arm rests while no joint leaves this band [rad]. Over a rest of 0.4 s that is 0.01 rad/s on average, a fifth
    of the limit in §6, and it leaves room for a servo that hunts against friction; its jerks begin and end at rest, so
    that their torque averages out."""
    settle_time: float = 0.1
    """Rest before averaging begins [s]: several time constants of the torque sensor's filter."""
    average_time: float = 0.3
    """Averaging time [s]: 75 samples at 250 Hz reduce sensor noise by a factor of nine."""
    noise_share: float = 1e-3
    """Initial standard deviation of one row, as a share of rated torque: half of one sample's noise of 0.2 %."""
    alarm_gain: float = 0.01
    """Gain change that the CUSUM is tuned to (§6)."""
    alarm_offset: float = 0.2
    """Offset change that the CUSUM is tuned to [N·m] (§6)."""
    window: int = 20
    """Rows of one test (§6): with 20 rows 98 % of the verdicts of 200 rows are reached, in 40 s of motion."""
    baseline_rows: int = 120
    """Drift-free rows that drift is measured against: gravity model and discrepancy are adapted to them. Three minutes,
    in which a drift of 0.5 % an hour is 0.03 %."""
    position_std: float = 1e-3
    """Standard deviation of a position sensor's zero [rad]; marginalised like the model's error."""
    zero_wander: float = 3e-3
    """Most that a zero moves with temperature (standard deviation), as a share of rated torque: a sensor of class 0.15,
    three times worse than good ones, by 20 K. Where the arm's discrepancy is small, less is assumed."""
    tool_windows: int = 60
    """Consecutive windows that find the same payload until it counts as a tool: half an hour of stops."""
    gain_std: float = 3e-3
    """A gain is written, and followed by the filter, only if the rows determine it to this standard deviation: 0.3 %
    (§6)."""
    offset_std: float = 0.02
    """An offset is written only if its standard deviation is smaller [N·m] (§6)."""
    rest_between_writes: float = 60.0
    """At most one write per joint in this time [s] (T_min of §6)."""
