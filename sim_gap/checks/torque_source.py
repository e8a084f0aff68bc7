"""Sign of rectified readings, and source of a torque channel."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armlink.recording.corrections import WITHOUT_GRAVITY, Corrections
from armlink.recording.recording import Recording
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.mapping import FITS
from sim_gap.checks.rigid_fit import MOVING_SHARE, TURNING, ChannelMotion, RigidFit, fit_model
from sim_gap.model.rigid_body import RigidArm
from sim_gap.residuals.preprocess import CHANNELS, PreparedSignals

GEAR_FRICTION = 0.13
"""Friction over torque (root sum of squares over the joints that move) from which a channel is a motor's: link sensors
of two real arms show 0.04 to 0.07, motors of four others 0.26 to 0.6."""
CARRIED, NO_GRAVITY, UNEXPLAINED = 0.3, 0.1, 0.2
"""Gravity over the reading (standard deviations) from which a joint carries some; gravity's part in the reading below
which it lacks it; share of the reading's variance that model and friction may leave, or nothing follows from that."""
LAWFUL, STEPS = 0.3, 50
"""Least share of the variance of a command's steps that a law of gains explains (half on OpenArm, where positions,
velocities and targets are rounded on the bus); least number of such steps."""
UNRELATED = 0.4
"""Correlation with the model's torque below which a reading that never changes its sign does not follow it."""
LITTLE, BETTER = 0.45, 0.4
"""Share of such a reading that model, friction and rotor explain, below which it may be unsigned, and the fall of the
cost with the model's sign from which it is; sound ones of real arms, a sensor with an offset, are at 0.51 and more."""
TOUCHES = 0.05
"""Lowest fiftieth of a reading that never changes its sign, over its standard deviation, below which it turns round at
zero, as rectified readings do; sound ones of real arms, a sensor with an offset, stay above 0.2."""


def find_unsigned(arm: RigidArm, motion: ChannelMotion, stated: Corrections) -> list[RecordingFinding]:
    """Readings that are never negative although the model's torque changes its sign."""
    model = arm.carried(motion.q, motion.v, motion.a)
    plain_fit = fit_model(model, motion)
    signed_fit = fit_model(model, replace(motion, reading=np.abs(motion.reading) * np.sign(model)))
    falls = plain_fit.cost - signed_fit.cost
    found = []
    for j in range(arm.n):
        y, m, explained = motion.reading[:, j], model[:, j], plain_fit.explained[j]
        if stated.states("sign", f"{motion.channel}_{j + 1}") or y.std() < 1e-9:
            continue
        both_ways = min(np.mean(motion.v[:, j] > 0.05), np.mean(motion.v[:, j] < -0.05)) > 0.1
        never = min(np.mean(y > 0.02 * y.std()), np.mean(y < -0.02 * y.std())) < 0.005
        crosses = min(np.mean(m > 0.0), np.mean(m < 0.0)) > 0.1
        if not (never and crosses and both_ways):
            continue
        folded, plain = (abs(np.corrcoef(np.abs(y), x)[0, 1]) for x in (np.abs(m), m))
        unrelated = motion.channel != "tau" and plain < UNRELATED and explained < FITS
        touches = np.quantile(np.abs(y), 0.02) < TOUCHES * y.std()
        follows = folded > max(plain + 0.2, 0.6)
        if follows or touches or unrelated or (explained < LITTLE and falls[j] > BETTER):
            how = f"it follows its magnitude ({folded:.2f})" if follows or not touches else "it turns back at zero"
            evidence = f"never changes its sign, though the model's torque does; {how}"
            option = f"record signed torque, or --sign {motion.channel}_{j + 1}=1 if it is right"
            found.append(RecordingFinding("unsigned", motion.channel, arm.names[j], evidence, option, False))
    return found


def find_without_gravity(arm: RigidArm, motion: ChannelMotion, stated: Corrections) -> list[RecordingFinding]:
    """A channel without the model's gravity at every joint that carries any: subtracted before it was recorded.

    One joint alone says nothing: a spring or a weight may balance it.
    """
    if stated.without_gravity or stated.states("units", f"{motion.channel}_1"):
        return []
    gravity = arm.torque(motion.q, 0.0 * motion.v, 0.0 * motion.a)
    rest = arm.carried(motion.q, motion.v, motion.a) - gravity
    weightless = 0
    for j in range(arm.n):
        moving = np.abs(motion.v[:, j]) > TURNING
        if gravity[:, j].std() < CARRIED * motion.reading[:, j].std() or moving.mean() < MOVING_SHARE:
            continue
        columns = [gravity[:, j], rest[:, j], motion.direction[:, j], motion.v[:, j], motion.a[:, j]]
        rows = np.stack([*columns, np.ones(len(moving))], axis=1)[moving]
        reading = motion.reading[moving, j]
        found = np.linalg.lstsq(rows, reading, rcond=None)[0]
        part = abs(found[0]) * gravity[:, j].std()
        if part > NO_GRAVITY * reading.std() or np.var(reading - rows @ found) > UNEXPLAINED * np.var(reading):
            return []
        weightless += 1
    if weightless < 2:
        return []
    evidence = f"lacks the model's gravity at each of the {weightless} joints that carry any: it was subtracted"
    return [RecordingFinding("effort_source", motion.channel, "all", evidence, f"--effort-is {WITHOUT_GRAVITY}", True)]


def with_gravity(arm: RigidArm, recording: Recording, channels: Sequence[str]) -> Recording:
    """The recording with the model's gravity added to these torque channels."""
    still = np.zeros_like(recording.position)
    gravity = arm.torque(recording.position, still, still)
    made = {CHANNELS[channel]: getattr(recording, CHANNELS[channel]) for channel in channels}
    return replace(recording, **{name: values + gravity for name, values in made.items() if values is not None})


def find_same(recording: Recording, stated: Corrections) -> list[RecordingFinding]:
    """A channel taken for a link sensor's that repeats the motors': arms without sensors have one reading of torque."""
    link, motor = recording.torque, recording.motor_torque
    if stated.effort or link is None or motor is None or not np.array_equal(link, motor, equal_nan=True):
        return []
    evidence = "equals tau_motor in every sample: these drives have one torque reading, that of their motors"
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
    evidence = "is kp (q_cmd − q) of its own row, but the drive acts at another time within the cycle; left out"
    return [RecordingFinding("clock", "tau_cmd", "all", evidence, "--clock tau_cmd=0 (keep it)", True)]


def find_source(
    fit: RigidFit, s: PreparedSignals, motion: ChannelMotion, stated: Corrections
) -> list[RecordingFinding]:
    """A channel taken for a link sensor's that holds the friction of gears: a motor's.

    One joint that has all that friction is asked about: it may be in another unit.
    """
    if motion.channel != "tau" or stated.effort or "tau_motor" in s.reading:  # then it is the bearings' friction
        return []
    moving = np.isfinite(fit.friction)
    friction, spread = np.maximum(fit.friction[moving], 0.0), fit.spread[moving]
    others = np.arange(len(friction)) != friction.argmax() if len(friction) > 2 else slice(None)
    share, without = (np.linalg.norm(friction[j]) / (np.linalg.norm(spread[j]) + 1e-12) for j in (slice(None), others))
    if share < GEAR_FRICTION:
        return []
    if without < GEAR_FRICTION:
        return _odd_joint(int(np.flatnonzero(moving)[friction.argmax()]), fit, s, stated)
    evidence = (
        f"contains friction ({share:.0%} of its torque), which a link-side sensor does not feel: it is a motor's effort"
    )
    return [RecordingFinding("effort_source", "tau", "all", evidence, "--effort-is motor", True)]


def _odd_joint(j: int, fit: RigidFit, s: PreparedSignals, stated: Corrections) -> list[RecordingFinding]:
    """A joint's reading that holds friction, unlike those of the others' link sensors."""
    column = f"tau_{j + 1}"
    if stated.states("units", column):
        return []
    evidence = (
        f"contains friction ({fit.friction[j] / fit.spread[j]:.0%} of its torque), which a link-side sensor does not "
        "feel, and no other joint does: is it in amperes, or a motor's effort?"
    )
    option = f"--units {column}=A:K (N·m/A at the joint), or {column}=N·m if it is right"
    return [RecordingFinding("scale", "tau", s.arm.names[j], evidence, option, False)]
