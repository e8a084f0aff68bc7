"""Entry point of the check before any fit: recordings and a model in, corrected recordings and findings out.

A finding that is certain is corrected; one that is not names the options that settle it, and the recording is diagnosed
as it is. Times, counts, jumps and ranges that no arm can have end the diagnosis, and without a torque channel commands
that do not belong to the positions do.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import WITHOUT_GRAVITY, Corrections, parse_corrections
from armlink.recording.recording import TORQUE_CHANNELS, Recording, default_names, take_joints
from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array
from gcomp.estimate.linear_terms import SIGNIFICANT
from sim_gap.checks.column_pairs import follows_position, require_commands, sound_velocity
from sim_gap.checks.columns import find_wrong_columns
from sim_gap.checks.finding import RecordingFinding, refuse
from sim_gap.checks.positions import find_beyond_range, find_counts, find_far, find_jumps, find_seam, unwrap
from sim_gap.checks.sampling import drop_held, drop_repeats, even_times, find_dropped, find_time_unit
from sim_gap.checks.sound_arm import motion_of
from sim_gap.residuals.preprocess import CHANNELS, SHORTEST_S, PreparedSignals, at_times, prepare

LEAST_WAY = 1.5
"""Way of the joints that move over their range (median) from which they turn back: a single stroke has 1."""
LEAST_RANGE = 0.1
"""Range from which a joint moves [rad]."""
LEAST_SHARE = 0.01
"""Way within that time, as a share of the joint's range, from which it moves."""
WAY_STEP_S = 0.1
"""Time between the positions whose distances make up the way [s]: noise of closer ones would."""


def goes_one_way(recording: Recording) -> bool:
    """Whether the joints that move go to and fro less than once, or none moves: a wrong column, sign or zero may fit
    one smooth curve over time as well as the right one does."""
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
    return t, at_times(t, recording.t, recording.position)


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
    """Recordings of one set-up with what is certainly wrong of mapping, units and clocks corrected, and all findings.

    What is not certain is left as recorded, and what is `stated` is made already and not looked into again. Raises
    BadInput for times, counts and angles that no arm can have.
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
    """One recording, as in `check_recordings`; `known` are options that corrected others."""
    refuse(label, find_time_unit(recording, stated), find_counts(recording, stated))
    recording, wrapped = unwrap(recording)
    refuse(label, find_jumps(recording, stated))
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
    if all(finding.corrected for finding in found):  # else a range is what the doubt is about
        refuse(label, find_beyond_range(arm, recording, stated))
    recording, velocity = sound_velocity(recording, stated)
    refuse(label, find_seam(recording, stated))
    return recording, [*found, *velocity]


def _with_right_columns(
    arm: RigidArm, recording: Recording, label: str, stated: Corrections, known: Collection[str]
) -> tuple[Recording, list[RecordingFinding]]:
    """The recording with what is certainly wrong with torque channels and positions put right, one thing after the
    other."""
    found, s = list[RecordingFinding](), _prepared(recording, arm, label, stated)
    for channel in CHANNELS:
        while channel in s.reading and len(found) < 2 * arm.n:
            motion = motion_of(s, channel)
            silent = motion.reading.std(0) < SIGNIFICANT * s.noise[channel]
            if silent.all():  # an arm that swings, its drives off
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


LAWFUL, STEPS = 0.3, 50
"""Least share of the variance of a command's steps that a law of gains explains (half on OpenArm, where positions,
velocities and targets are rounded on the bus); least number of such steps."""


def with_gravity(arm: RigidArm, recording: Recording, channels: Sequence[str]) -> Recording:
    """The recording with the model's gravity added to these torque channels."""
    gravity = arm.gravity_torque(recording.position)
    made = {CHANNELS[channel]: getattr(recording, CHANNELS[channel]) for channel in channels}
    return replace(recording, **{name: values + gravity for name, values in made.items() if values is not None})


def find_same(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """A channel taken for a link sensor's that repeats the motors': arms without sensors have one reading of torque."""
    link, motor = recording.torque, recording.motor_torque
    if stated.effort or link is None or motor is None or not np.array_equal(link, motor, equal_nan=True):
        return []
    evidence = (
        "the channel equals tau_motor in every sample, so these drives have only one torque reading, the torque "
        "of their motors"
    )
    return [RecordingFinding("effort_source", "tau", "all", evidence, "--effort-is motor", True)]


def find_gain_command(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """Commanded torque that is the law of drives with gains at the row's readings: kp (q_cmd − q) + kd (…) + τ.

    The drive follows the position within its cycle, and the command may be another one already: the law then differs
    from the torque made by kp times the way of half a cycle or more, which is far more than friction's uncertainty.
    """
    command, target, velocity = recording.torque_command, recording.position_command, recording.velocity
    if "tau_cmd" in stated.clock or command is None or target is None or velocity is None:
        return []
    lawful = 0
    for own, error, speed in zip(command.T, (target - recording.position).T, velocity.T, strict=True):
        steps = np.diff(np.stack([own, error, speed]), axis=1)
        steps = steps[:, np.isfinite(steps).all(axis=0)]
        if steps.shape[1] < STEPS or np.ptp(steps[0]) == 0.0 or np.ptp(steps[1]) == 0.0:
            continue
        law = np.linalg.lstsq(steps[1:].T, steps[0], rcond=None)[0]
        lawful += bool(np.var(law @ steps[1:]) > LAWFUL * np.var(steps[0]) and law[0] > 0.0)
    if 2 * lawful <= recording.position.shape[1]:
        return []
    evidence = (
        "the torque was computed as kp (q_cmd − q) from the values of the same row, but the drive computes it "
        "at another time in the cycle, so the channel is left out"
    )
    return [RecordingFinding("clock", "tau_cmd", "all", evidence, "--clock tau_cmd=0 (to keep the channel)", True)]


def is_position_only(recording: Recording) -> bool:
    """Whether no torque channel of a recording holds a number."""
    channels = [getattr(recording, name) for name in TORQUE_CHANNELS]
    return all(values is None or not np.isfinite(values).any() for values in channels)


def check_position_only(
    arm: RigidArm, recordings: Sequence[Recording], labels: Sequence[str], stated: Corrections
) -> tuple[list[Recording], list[RecordingFinding]]:
    """Recordings on their sample times, without repeated rows, and the findings.

    Raises BadInput where commands and positions do not belong together, with the option that settles it.
    """
    checked, found = [], []
    short = [k for k, r in enumerate(recordings) if r.t[-1] - r.t[0] < SHORTEST_S]
    for k in range(len(recordings)):
        if k not in short:
            require_commands([recordings[k]], labels[k], stated)
    if short:  # together, since a lag turns what a single step seems to follow
        more = f" and {len(short) - 1} more" if len(short) > 1 else ""
        require_commands([recordings[k] for k in short], labels[short[0]] + more, stated)
    for recording, label in zip(recordings, labels, strict=True):
        if recording.position_command is None or not np.isfinite(recording.position_command).any():
            raise BadInput(
                f"{label}: no torque channel and no commanded position has a number: record tau_1 …, "
                "tau_motor_1 … or tau_cmd_1 …, or q_cmd_1 …"
            )
        refuse(label, find_counts(recording, stated), find_beyond_range(arm, recording, stated))
        refuse(label, find_far(arm, recording, stated))
        recording, repeated = drop_repeats(recording)
        recording, jitter = even_times(recording, stated)
        dropped = [] if repeated else find_dropped(recording)
        checked.append(recording)
        found += [finding for finding in (*repeated, *jitter, *dropped) if finding not in found]
    return checked, found


# ---- joints of a recording and of the model, matched by name where the recording has names

FILLERS = {"joint", "joints", "jnt", "motor", "link", "arm", "robot", "actuator", "axis", "j", "pos"}
"""Words of joint names that say nothing about which joint it is."""


def match_joints(
    recording: Recording, model: Sequence[str], stated: Corrections, label: str
) -> tuple[Recording, list[RecordingFinding]]:
    """The recording's joints in the order of the model's (base to tip), named as there, and a finding where names were
    matched that differ. Raises BadInput where it is not certain which joint is which.

    With `joints` stated, those are the model's, whatever they are called; without names the columns' order counts.
    """
    own = recording.names
    if stated.joints:
        return (replace(recording, names=tuple(model)) if len(own) == len(model) else recording), []
    known = [name for name in model if name in own]
    if known and (len(known) == len(model) or len(known) == len(own)):
        return _taken(recording, known, known), []
    if own == default_names(recording.n):
        return recording, []
    matched = _by_words(own, model)
    if matched is None and any(column.startswith("q_") for column in stated.columns):
        return replace(recording, names=default_names(recording.n)), []  # the order is that of --map
    if matched is None:
        raise BadInput(
            f"{label}: the recording has the joints ({', '.join(own)}), but the model has "
            f"({', '.join(model)}): name the joints of the recording in the order of the model, for example "
            f"--joints {','.join(own[: len(model)])}"
        )
    pairs = ", ".join(f"{name} as {to}" for to, name in matched.items())
    finding = RecordingFinding(
        "order", "q", "all", f"the joints were matched by name: {pairs}", "--joints " + ",".join(matched.values()), True
    )
    return _taken(recording, list(matched.values()), list(matched)), [finding]


def _taken(recording: Recording, names: Sequence[str], called: Sequence[str]) -> Recording:
    left = [name for name in recording.names if name not in names]
    taken = take_joints(recording, [recording.names.index(name) for name in names], tuple(called))
    note = f"joints left out because the model does not have them: {', '.join(left)}" if left else ""
    return replace(taken, warning="; ".join(filter(None, (recording.warning, note))))


def _by_words(own: Sequence[str], model: Sequence[str]) -> dict[str, str] | None:
    """Model joint → recorded joint, where each model joint has exactly one recorded one with its words."""
    words = {name: _words(name) for name in own}
    matched = {}
    for name in model:
        wanted = _words(name)
        if not wanted:
            return None
        equal = [other for other in own if words[other] == wanted]
        near = equal or [other for other in own if words[other] and (words[other] > wanted or words[other] < wanted)]
        if len(near) != 1:
            return None
        matched[name] = near[0]
    return matched if len(set(matched.values())) == len(model) else None


def _words(name: str) -> frozenset[str]:
    """Words and numbers of a joint's name that tell it from others."""
    parts = re.findall(r"[a-z]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
    return frozenset(part.lstrip("0") or "0" if part.isdigit() else part for part in parts) - FILLERS
