"""Entry point of the check: recordings and a model in, corrected recordings and findings out.

Run before anything is fitted. A finding that is certain is corrected; one that is not names the options that settle it,
and the recording is diagnosed as it is. Times, counts, jumps and ranges that no arm can have end the diagnosis.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import WITHOUT_GRAVITY, Corrections, parse_corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.checks.channel_motion import motion_of
from sim_gap.checks.column_pairs import follows_position, sound_velocity
from sim_gap.checks.columns import find_wrong_columns
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.joint_range import find_beyond_range, find_counts
from sim_gap.checks.jumps import find_jumps, find_seam, unwrap
from sim_gap.checks.sampling import drop_held, drop_repeats, even_times, find_dropped, find_time_unit
from sim_gap.checks.torque_source import find_gain_command, find_same, with_gravity
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import CHANNELS, PreparedSignals, prepare

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
        "order, signs, zeros, units and clocks of the columns could not be checked, since the joints move in one "
        "direction only, or hardly at all: record motion in both directions",
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
    each = [check_recording(arm, r, label, stated) for r, label in zip(recordings, labels, strict=True)]
    columns = {"q", *CHANNELS}
    options = [{f.option for f in findings if f.corrected and f.channel in columns} for _, findings in each]
    known = set().union(*options)
    for k, own in enumerate(options):
        if known > own:  # one set-up: what is certain in one recording is likely in another
            each[k] = check_recording(arm, recordings[k], labels[k], stated, known)
    checked, found = [recording for recording, _ in each], dict[object, RecordingFinding]()
    for _, findings in each:
        for finding in findings:  # a doubt is asked about once, whatever each recording shows of it
            found.setdefault(finding if finding.corrected else (finding.joint, finding.option), finding)
    return checked, list(found.values())


def check_recording(
    arm: RigidArm, recording: Recording, label: str, stated: Corrections, known: Collection[str] = ()
) -> tuple[Recording, list[RecordingFinding]]:
    """Check and correct one recording, as `check_recordings`; `known` are options that corrected others."""
    for finding in [*find_time_unit(recording, stated), *find_counts(recording, stated)]:
        raise BadInput(f"{label}: {finding.refusal()}")
    recording, wrapped = unwrap(recording)
    for finding in find_jumps(recording, stated):
        raise BadInput(f"{label}: {finding.refusal()}")
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
    if not goes_one_way(recording):
        recording, wrong = _with_right_columns(arm, recording, label, stated, known)
        found += wrong
    beyond = find_beyond_range(arm, recording, stated)
    if beyond and all(finding.corrected for finding in found):  # else it is what the doubt is about
        raise BadInput(f"{label}: {beyond[0].refusal()}")
    recording, velocity = sound_velocity(recording, stated)
    for finding in find_seam(recording, stated):
        raise BadInput(f"{label}: {finding.refusal()}")
    return recording, [*found, *velocity]


def _with_right_columns(
    arm: RigidArm, recording: Recording, label: str, stated: Corrections, known: Collection[str]
) -> tuple[Recording, list[RecordingFinding]]:
    """The recording with what is certainly wrong with torque channels and positions put right, one thing after the
    other."""
    found, s = list[RecordingFinding](), _prepared(recording, arm, label, stated)
    for channel in CHANNELS:
        while channel in s.channels and len(found) < 2 * arm.n:
            motion = motion_of(s, channel)
            if bool((motion.reading.std(0) < SIGNAL * s.noise[channel]).all()):  # of an arm that swings, its drives off
                break
            finding = find_wrong_columns(arm, motion, stated, follows_position(recording), known)
            if finding is None or finding.option in {each.option for each in found}:
                break
            found.append(finding)
            if not finding.corrected:
                break
            recording = _corrected(recording, finding, label, arm)
            s = _prepared(recording, arm, label, stated)
    return recording, found


def _prepared(recording: Recording, arm: RigidArm, label: str, stated: Corrections) -> PreparedSignals:
    """The recording with velocities of its own only if they are those of the positions."""
    return prepare(sound_velocity(recording, stated)[0], arm, label)


def _corrected(recording: Recording, finding: RecordingFinding, label: str, arm: RigidArm) -> Recording:
    """The recording after the correction that a finding's option makes."""
    name, _, value = finding.option.partition(" ")
    keys = {"--sign": "sign", "--units": "units", "--zero": "zero", "--clock": "clock", "--map": "columns"}
    if value == WITHOUT_GRAVITY:
        return with_gravity(arm, recording, [finding.channel])
    if name == "--effort-is":
        return parse_corrections(effort_is=value).apply(recording, label)
    made = parse_corrections(**{keys[name]: [value]})  # type: ignore[arg-type]
    return replace(made.apply(recording, label), warning=recording.warning)
