"""Entry point of the check: recordings and a model in, corrected recordings and findings out.

Run before anything is fitted. A finding that is certain is corrected; one that is not ends the diagnosis with the
option that settles it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import WITHOUT_GRAVITY, Corrections, parse_corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.checks.column_order import find_changed_order
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.held_out import is_certain, is_refuted, shown_by
from sim_gap.checks.joint_range import find_beyond_range, find_counts
from sim_gap.checks.jumps import find_jumps, find_seam, unwrap
from sim_gap.checks.mapping import SURE, find_mapping
from sim_gap.checks.mounting import find_mounting
from sim_gap.checks.rigid_fit import ChannelMotion, fit_beside_slow_torques, fit_rigid, motion_of
from sim_gap.checks.sampling import drop_held, drop_repeats, even_times, find_dropped, find_time_unit
from sim_gap.checks.small_zero import find_small_zero
from sim_gap.checks.torque_delay import find_delay, find_short_delay
from sim_gap.checks.torque_source import (
    find_gain_command,
    find_same,
    find_source,
    find_unsigned,
    find_without_gravity,
    with_gravity,
)
from sim_gap.checks.torque_unit import find_absent, find_joint_scale, find_outgrown, find_scale
from sim_gap.checks.velocity import follows_position, sound_velocity
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import CHANNELS, TRIM_S, PreparedSignals, prepare

LEAST_WAY = 1.5
"""Way of the joints that move over their range (median) from which they turn back: a single stroke has 1."""
SIGNAL = 2.0
"""Standard deviation of a reading over that of its noise from which it holds a signal."""
LEAST_RANGE = 0.1
"""Range from which a joint moves [rad]."""
LEAST_SHARE = 0.01
"""Way within that time, as a share of the joint's range, from which it moves."""
WAY_STEP_S = 0.1
"""Time between the positions whose distances make up the way [s]: noise of closer ones would."""


def goes_one_way(recording: Recording) -> bool:
    """Whether the joints that move go to and fro less than once, or none moves.

    Then every angle and every torque is one smooth curve over time, and a wrong column, sign or zero may fit such a
    curve as well as the right one does.
    """
    _, q = _thinned(recording)
    span = np.ptp(q, axis=0)
    moving = span > LEAST_RANGE
    if not moving.any():
        return True
    return bool(np.median(np.abs(np.diff(q[:, moving], axis=0)).sum(0) / span[moving]) < LEAST_WAY)


def times_in_motion(recording: Recording) -> Array:
    """Times at which some joint moves by a share of its range that is not noise [s], (k,)."""
    t, q = _thinned(recording)
    span = np.ptp(q, axis=0)
    way = np.abs(np.diff(q, axis=0)) / np.maximum(span, LEAST_RANGE)
    return np.asarray(t[1:][way.max(axis=1) > LEAST_SHARE])


def _thinned(recording: Recording) -> tuple[Array, Array]:
    """Even times and the positions there, far enough apart that noise makes no way of its own, (k,) and (k, n)."""
    t = np.arange(recording.t[0], recording.t[-1], WAY_STEP_S)
    known = [np.isfinite(x) for x in recording.position.T]
    columns = [np.interp(t, recording.t[k], x[k]) for k, x in zip(known, recording.position.T, strict=True)]
    return t, np.column_stack(columns)


def unchecked_note(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """A sentence if no recording turns back."""
    if not all(goes_one_way(recording) for recording in recordings):
        return ()
    return (
        "order, signs, zeros and clocks of the columns could not be checked: the joints move one way only, or "
        "hardly at all; record motion to and fro",
    )


def check_recordings(
    arm: RigidArm, recordings: Sequence[Recording], labels: Sequence[str], stated: Corrections
) -> tuple[list[Recording], list[RecordingFinding]]:
    """Correct recordings whose mapping, units or clocks are certainly wrong.

    Args:
        arm: nominal arm, its joints in the recordings' order.
        recordings: recordings of one set-up, in SI as far as is known.
        labels: their names for messages.
        stated: corrections that the user stated, already made; those are not looked into again.

    Returns the corrected recordings and the findings of all. What is not certain is left as recorded and among the
    findings. Raises BadInput for times, counts and angles that no arm can have.
    """
    checked, found = list[Recording](), dict[object, RecordingFinding]()
    for recording, label in zip(recordings, labels, strict=True):
        corrected, findings = check_recording(arm, recording, label, stated)
        checked.append(corrected)
        for finding in findings:  # a doubt is asked about once, whatever each recording shows of it
            found.setdefault(finding if finding.corrected else (finding.joint, finding.option), finding)
    return checked, list(found.values())


def check_recording(
    arm: RigidArm, recording: Recording, label: str, stated: Corrections
) -> tuple[Recording, list[RecordingFinding]]:
    """Check and correct one recording, as `check_recordings`."""
    for finding in [*find_time_unit(recording, stated), *find_counts(recording, stated)]:
        raise BadInput(f"{label}: {finding.sentence()}")
    recording, wrapped = unwrap(recording)
    for finding in find_jumps(recording, stated):
        raise BadInput(f"{label}: {finding.sentence()}")
    recording, repeated = drop_repeats(recording)
    recording, held = drop_held(recording)
    recording, jitter = even_times(recording, stated)
    same = find_same(recording, stated)
    for finding in same:
        recording = _corrected(recording, finding, label, arm)
    if same and (law := find_gain_command(recording, stated)):
        same, recording = [*same, *law], replace(recording, torque_command=None)
    if stated.without_gravity:
        recording = with_gravity(arm, recording, tuple(CHANNELS))
    found = [*wrapped, *repeated, *held, *jitter, *([] if repeated else find_dropped(recording)), *same]
    s = _prepared(recording, arm, label, stated)
    for channel in s.channels:
        view = _view(arm, s, channel, recording, stated)
        if view.silent:
            continue
        for look in (_gravity, _unsigned, _mapping, _source):
            findings = look(view)
            if look in (_gravity, _mapping):
                findings = _tested(view, findings, label, look is _gravity)
            found += findings
            certain = [finding for finding in findings if finding.corrected]
            if len(certain) < len(findings):  # what looks on would see the same fault again
                break
            for finding in certain:
                recording = _corrected(recording, finding, label, arm)
            if not certain:
                continue
            s = _prepared(recording, arm, label, stated)
            if channel not in s.channels:  # taken for another one
                break
            view = _view(arm, s, channel, recording, stated)
    beyond = find_beyond_range(arm, recording, stated)
    if beyond and all(finding.corrected for finding in found):  # else it is what the doubt is about
        raise BadInput(f"{label}: {beyond[0].sentence()}")
    recording, velocity = sound_velocity(recording, stated)
    for finding in find_seam(recording, stated):
        raise BadInput(f"{label}: {finding.sentence()}")
    return recording, [*found, *velocity]


def _tested(
    view: "_ChannelView", findings: list[RecordingFinding], label: str, gravity: bool
) -> list[RecordingFinding]:
    """The findings; none of those that would be corrected unless the recording is predicted better then than as it is
    with effects of the arm.

    Masses and springs of usual size explain most of a missing `gravity`, too, but not that all joints lack it alike:
    that is given up only where the recording is predicted worse. A base on its side is no rival of it.
    """
    recording = view.recording
    if not findings or not all(finding.corrected for finding in findings):
        return findings
    for finding in findings:
        recording = _corrected(recording, finding, label, view.arm)
    s = _prepared(recording, view.arm, label, view.stated)
    if view.motion.channel not in s.channels:
        return findings
    arms = [view.arm] if gravity else [view.arm, view.mounted]
    shown = shown_by(arms, view.motion, motion_of(s, view.motion.channel), view.rate)
    return findings if (not is_refuted(shown) if gravity else is_certain(shown)) else []


def _prepared(recording: Recording, arm: RigidArm, label: str, stated: Corrections) -> PreparedSignals:
    """The recording with velocities of its own only if they are those of the positions."""
    return prepare(sound_velocity(recording, stated)[0], arm, label)


@dataclass(frozen=True, eq=False)
class _ChannelView:
    """One torque channel of a recording as the checks look at it."""

    arm: RigidArm
    mounted: RigidArm
    s: PreparedSignals
    motion: ChannelMotion
    recording: Recording
    stated: Corrections

    @cached_property
    def one_way(self) -> bool:
        return goes_one_way(self.recording)

    @property
    def rate(self) -> float:
        """Rows per second."""
        return float((len(self.motion.q) - 1) / max(self.s.t[-1] - 2.0 * TRIM_S, 1e-9))

    @property
    def silent(self) -> bool:
        """Whether the channel holds noise alone, as of an arm that swings with its drives off: nothing has a place."""
        return bool((self.motion.reading.std(0) < SIGNAL * self.s.noise[self.motion.channel]).all())

    def in_time(self, delay: RecordingFinding) -> ChannelMotion:
        """The motion with a delay of its channel taken off."""
        corrected = _corrected(self.recording, delay, self.s.label, self.arm)
        return motion_of(_prepared(corrected, self.arm, self.s.label, self.stated), self.motion.channel)


def _view(arm: RigidArm, s: PreparedSignals, channel: str, recording: Recording, stated: Corrections) -> _ChannelView:
    motion = motion_of(s, channel)
    return _ChannelView(arm, find_mounting(arm, motion), s, motion, recording, stated)


def _gravity(view: _ChannelView) -> list[RecordingFinding]:
    """A channel from which gravity was subtracted."""
    return [] if view.one_way else find_without_gravity(view.arm, view.motion, view.stated)


def _unsigned(view: _ChannelView) -> list[RecordingFinding]:
    """Joints that read amounts, unless they do not with the channel's delay taken off."""
    found = find_unsigned(view.mounted, view.motion, view.stated)
    if not found or view.one_way:
        return found
    delay, _ = find_delay(view.mounted, view.motion, view.rate, view.stated)
    if not delay:
        return found
    return [] if not find_unsigned(view.mounted, view.in_time(delay[0]), view.stated) else found


def _mapping(view: _ChannelView) -> list[RecordingFinding]:
    """Findings on clock, order, sign, zero and angle unit, in the order in which they are corrected."""
    arm, mounted, motion, stated = view.arm, view.mounted, view.motion, view.stated
    if view.one_way:
        return []
    follows = follows_position(view.recording)
    mapping, midway = find_mapping(arm, motion, stated, follows, mounted), find_changed_order(mounted, motion, stated)
    zero = [] if mapping or midway else find_small_zero(arm, motion, stated, follows)
    delay, fall = find_delay(mounted, motion, view.rate, stated)
    gained, changed, moved = (sum(each.fall for each in found) for found in (mapping, midway, zero))
    if not delay or fall <= max(SURE + max(gained, changed), moved):
        if changed > SURE + gained:
            return midway
        return mapping or midway or zero or find_short_delay(mounted, motion, view.rate, stated)
    return [*delay, *find_mapping(arm, view.in_time(delay[0]), stated, follows)]


def _source(view: _ChannelView) -> list[RecordingFinding]:
    """Findings on the channel's scale and on what it is a reading of."""
    arm, mounted, motion, stated = view.arm, view.mounted, view.motion, view.stated
    fit = fit_beside_slow_torques(mounted, motion, fit_rigid(mounted, motion))
    scale = (
        find_joint_scale(mounted, motion, stated)
        or find_scale(arm, fit, motion, stated)
        or find_outgrown(arm, mounted, motion, stated)
        or ([] if view.one_way else find_absent(arm, fit, motion, stated))
    )
    return [*scale, *find_source(fit, view.s, motion, stated)]


def _corrected(recording: Recording, finding: RecordingFinding, label: str, arm: RigidArm) -> Recording:
    """The recording after the correction that a finding's option makes."""
    name, _, value = finding.option.partition(" ")
    keys = {"--sign": "sign", "--units": "units", "--zero": "zero", "--clock": "clock", "--map": "columns"}
    if value == WITHOUT_GRAVITY:
        return with_gravity(arm, recording, [finding.channel])
    if name == "--effort-is":
        return parse_corrections(effort=value).apply(recording, label)
    made = parse_corrections(**{keys[name]: [value]})  # type: ignore[arg-type]
    return replace(made.apply(recording, label), warning=recording.warning)
