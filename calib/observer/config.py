"""Every threshold of the observer, with its unit and the reason for its value."""

from dataclasses import dataclass

CHI2_1_AT_1E_3 = 10.8
"""χ² with 1 degree of freedom that noise exceeds once in 1000."""
CHI2_2_AT_1E_3 = 13.8
"""χ² with 2 degrees of freedom that noise exceeds once in 1000."""


@dataclass(frozen=True)
class ObserverConfig:
    """Thresholds of rest detection, filter, alarm, cause test and decision (theory.md section 6)."""

    # rest detection: one row per stop
    still_band: float = 4e-3
    """The arm rests while no joint leaves this band [rad]: over a rest that is 0.01 rad/s on average, and room for a
    servo that hunts against friction; its jerks average out, since they begin and end at rest."""
    settle_time: float = 0.1
    """Rest before averaging begins [s]: several periods of the torque sensor's filter."""
    average_time: float = 0.3
    """Averaging [s]: 75 samples at 250 Hz take sensor noise down nine times."""
    gap_time: float = 0.05
    """A rest with readings missing for longer starts again [s]: 12 cycles at 250 Hz."""
    new_pose: float = 0.05
    """A stop counts as another one when some joint has moved so far [rad]: a long rest is one row."""

    noise_share: float = 1e-3
    """Standard deviation of one row assumed at first, as a share of rated torque: half a sample's noise of 0.2 %."""
    noise_rows: float = 5.0
    """Rows that the standard deviation given at the start counts for; since then the halves of each average tell it."""
    noise_memory: float = 200.0
    """Rows that it is averaged over."""

    # per-joint filter
    drift_gain: float = 1e-4
    """Random walk of the gain per accepted row: √(q σ/τ_rms) is then the 0.05 % that a joint of 10 N·m can hold."""
    drift_offset: float = 2e-3
    """Random walk of the offset per accepted row [N·m]: 0.01 N·m at σ = 0.05 N·m."""
    initial_gain_std: float = 5e-3
    """What is believed of a gain just installed: the accuracy asked of a calibration."""
    initial_offset_std: float = 0.05
    """What is believed of an offset just installed [N·m]: likewise."""
    outlier: float = CHI2_1_AT_1E_3
    """A row whose squared innovation over its variance is larger does not enter the filter."""
    outliers_in_a_row: int = 3
    """So many at once are an event, not outliers."""
    excitation_std: float = 3e-3
    """Gain is updated only where the last rows could tell it to this standard deviation: K·Var τ ≥ (σ/δk)²."""
    excitation_rows: int = 60
    """Rows that the excitation gate looks back on."""
    place_size: float = 0.2
    """Poses within this distance in every joint are one place [rad]."""
    place_rows: int = 3
    """Rows of one place that the filter and a window take: a repeated pose adds nothing."""
    place_memory: int = 20
    """Rows that the mean residual of a place is made of: what is left of its error is small against an alarm."""
    places: int = 60
    """Places remembered."""

    # alarm
    alarm_gain: float = 0.01
    """Gain change that the CUSUM is tuned to."""
    alarm_offset: float = 0.2
    """Offset change that it is tuned to [N·m]."""
    alarm_threshold: float = 10.0
    """Log-likelihood ratio: one false alarm in 1.1e4 rows of a seven-joint arm; it only starts a test."""

    # cause test
    window: int = 20
    """Rows of one test: at 20, 98 % of the verdicts of 200 are reached, in 40 s of motion."""
    audit_rows: int = 10
    """Rows between tests while no alarm stands, each on the last `longest_window`: what is too small for an alarm."""
    longest_window: int = 60
    """Rows kept for a test that could not tell yet, and for the final estimate."""
    evidence: float = 10.0
    """BIC difference that counts as decided ("very strong")."""
    misfit: float = 4.0
    """(χ² − dof)/√(2 dof) above which no entry explains the window."""
    position_std: float = 1e-3
    """How well a position reading's zero is known [rad]; marginalised like the model's error."""
    patience: int = 120
    """Rows after an alarm that may be left out as repeated poses before the test is given up as undecided."""
    baseline_rows: int = 40
    """Rows without drift from which the model takes over what the sensors, as installed, read."""

    tool_windows: int = 60
    """Windows that one and the same payload is carried before it counts as a tool: half an hour of stops."""

    # decision
    gain_std: float = 3e-3
    """A gain is written only if known better (0.3 %)."""
    offset_std: float = 0.02
    """An offset is written only if known better [N·m]."""
    significance: float = 5.0
    """A change is written only if it is so many standard deviations."""
    agreement: float = CHI2_2_AT_1E_3
    """Two disjoint windows agree when the χ² of their difference (gain, offset) is smaller."""
    lever_share: float = 0.3
    """A gain is written only if gravity's lever Γ on the joint reached this share of g in the window."""
    common_joints: int = 3
    """So many joints drifting at once: suspect gravity, payload or supply voltage; write none."""
    rest_between_writes: float = 60.0
    """At most one write per joint in this time [s]."""
