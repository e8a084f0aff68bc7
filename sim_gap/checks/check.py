"""Entry point of the check: recordings and a model in, corrected recordings and findings out.

Run before anything is fitted. A finding that is certain is corrected; one that is not ends the diagnosis with the
option that settles it.
"""

from collections.abc import Sequence
from dataclasses import replace

from armlink.errors import BadInput
from armlink.recording.corrections import Corrections, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.checks.clock import even_times, without_repeats
from sim_gap.checks.finding import Finding
from sim_gap.checks.mapping import SURE, find_mapping
from sim_gap.checks.rigid_fit import as_mounted, fit_rigid, motion_of
from sim_gap.checks.torque_source import find_delay, find_scale, find_source, find_unsigned
from sim_gap.checks.velocity import follows_position, sound_velocity
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import TRIM_S, prepare


def check_recordings(
    arm: RigidArm, recordings: Sequence[Recording], labels: Sequence[str], stated: Corrections
) -> tuple[list[Recording], list[Finding]]:
    """Correct recordings whose mapping, units or clocks are certainly wrong.

    Args:
        arm: nominal arm, its joints in the recordings' order.
        recordings: recordings of one set-up, in SI as far as is known.
        labels: their names for messages.
        stated: corrections that the user stated, already made; those are not looked into again.

    Returns the corrected recordings and the findings of all. Raises BadInput for a finding that is not certain.
    """
    checked, found = [], []
    for recording, label in zip(recordings, labels, strict=True):
        corrected, findings = check_recording(arm, recording, label, stated)
        checked.append(corrected)
        found += [finding for finding in findings if finding not in found]
    return checked, found


def check_recording(
    arm: RigidArm, recording: Recording, label: str, stated: Corrections
) -> tuple[Recording, list[Finding]]:
    """Check and correct one recording. Raises BadInput for a finding that is not certain."""
    recording, repeated = without_repeats(recording)
    recording, jitter = even_times(recording, stated)
    found = [*repeated, *jitter]
    channels = list(prepare(recording, arm, label).reading)
    for channel in channels:
        findings = _torque_findings(arm, recording, label, channel, stated)
        for finding in findings:
            if not finding.corrected:
                raise BadInput(f"{label}: {finding.sentence()}")
            recording = _corrected(recording, finding, label)
        found += findings
    recording, velocity = sound_velocity(recording, stated)
    return recording, [*found, *velocity]


def _torque_findings(
    arm: RigidArm, recording: Recording, label: str, channel: str, stated: Corrections
) -> list[Finding]:
    """Findings on one torque channel and the positions; those that a correction could hide are looked for after it."""
    s = prepare(recording, arm, label)
    motion = motion_of(s, channel)
    mounted = as_mounted(arm, motion)
    unsigned = find_unsigned(mounted, motion, stated)
    if unsigned:
        return unsigned
    follows = follows_position(recording)
    mapping = find_mapping(arm, motion, stated, follows)
    delay, fall = find_delay(mounted, motion, (len(motion.q) - 1) / max(s.t[-1] - 2.0 * TRIM_S, 1e-9), stated)
    if delay and fall > SURE + sum(finding.fall for finding in mapping):
        recording = _corrected(recording, delay[0], label)
        s = prepare(recording, arm, label)
        mapping = find_mapping(arm, motion_of(s, channel), stated, follows)
    else:
        delay = []
    if any(not finding.corrected for finding in mapping):
        return [*delay, *mapping]
    for finding in mapping:
        recording = _corrected(recording, finding, label)
    s = prepare(recording, arm, label)
    motion = motion_of(s, channel)
    fit = fit_rigid(as_mounted(arm, motion), motion)
    return [*delay, *mapping, *find_scale(arm, fit, motion, stated), *find_source(fit, s, motion, stated)]


def _corrected(recording: Recording, finding: Finding, label: str) -> Recording:
    """The recording after the correction that a finding's option makes."""
    name, _, value = finding.option.partition(" ")
    keys = {"--sign": "sign", "--units": "units", "--zero": "zero", "--clock": "clock", "--map": "columns"}
    if name == "--effort-is":
        return parse_corrections(effort=value).apply(recording, label)
    made = parse_corrections(**{keys[name]: [value]})  # type: ignore[arg-type]
    return replace(made.apply(recording, label), warning=recording.warning)
