"""Friction compensation: recordings whose controller adds a torque against friction, found from the recordings alone.

Two signs of it. A command that holds it follows the noise of the measured velocity, with a law like that of friction
and the sign that drives the motion on, where damping has the other sign. A torque channel that lacks it shows hardly
any friction, or negative friction, in a recording while the arm's other recordings show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.residuals.layout import Row
from sim_gap.residuals.preprocess import PreparedSignals
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.estimate import EffectEstimate

LAGS = 3
"""Number of samples by which the command may follow the velocity, from 0."""
VISCOUS = 3 * LAGS
"""First column of the viscous law."""
SMOOTHING_SAMPLES = 21
"""Samples over which the velocity is smoothed."""
SPEEDS = tuple(0.0025 * 2.0 ** (k / 2) for k in range(15))
"""Speeds at which the compensation has half of its torque [rad/s]."""
FEWEST, FEWEST_MOVING = 200, 50
"""Number of samples from which a command is judged, and of samples in motion from which a joint's friction is."""
FOLLOWS, SURE = 0.3, 10.0
"""Least share of the command's changes that only friction compensation accounts for, and least torque of it in standard
errors. With it, a real arm has shares of 0.94 and 1.0; of 165 joints of real recordings without it, taken as commands,
9 have more than 0.1 and none more than 0.3."""
SLIGHT = 0.01
"""Share of a command's spread that its compensation must have to be told: damping alone leaves a trace of a dry law."""
LEAST_SHARE = 0.25
"""A recording with less than this share of the friction of the others lacks it."""
CLEAR = 4.0
"""Least difference to the others, in standard errors of the recording's own friction."""


@dataclass(frozen=True)
class Compensation:
    recording: str
    joint: str
    channel: str
    held: bool
    """Whether the channel holds it: the friction of the joint shows there in full."""
    torque: float
    """Dry torque that the controller adds, where held; else the friction that shows at the mean speed [N·m]."""
    viscous: float = 0.0
    """Torque that it adds per speed [N·m·s/rad], where held."""
    usual: float | None = None
    """Friction in the other recordings [N·m], where not held; None without others."""

    def sentence(self) -> str:
        if self.held:
            law = f"{self.torque:.2g} N·m" + (f" and {self.viscous:.2g} N·m·s/rad" if abs(self.viscous) > 0.01 else "")
            return (
                f"{self.recording}: the controller compensates the friction of {self.joint}: {self.channel} contains "
                f"a torque of {law} in the direction of the measured velocity"
            )
        beside = "" if self.usual is None else f" ({self.usual:.2g} in the other recordings)"
        return (
            f"{self.recording}: {self.joint} shows only {self.torque:.2g} N·m of friction{beside}: the "
            f"controller compensates friction with a torque that {self.channel} does not contain; leave this "
            "recording out, or record the whole command"
        )


def held_in_commands(recordings: Sequence[Recording], labels: Sequence[str]) -> list[Compensation]:
    """Friction compensation that the commanded torque holds, of recordings as they were made (not resampled)."""
    out = []
    for recording, label in zip(recordings, labels, strict=False):
        command, velocity = recording.torque_command, recording.velocity
        for joint in range(recording.n) if command is not None and velocity is not None else ():
            law = _law(command[:, joint], velocity[:, joint], recording.position[:, joint])  # type: ignore[index]
            if law:
                out.append(Compensation(label, recording.names[joint], "tau_cmd", True, *law))
    return out


def _law(command: Array, velocity: Array, position: Array) -> tuple[float, float] | None:
    """Dry [N·m] and viscous [N·m·s/rad] torque with which a command follows the measured velocity; None if it does not.

    Second differences leave the noise alone, in which a command that knows only the plan has no part, nor has one that
    the joint's true friction made: that follows the smoothed velocity.
    """
    if len(command) < FEWEST:
        return None
    best: tuple[float, float, float] | None = None
    smooth = np.asarray(savgol_filter(velocity, SMOOTHING_SAMPLES, 2, mode="nearest"))
    bent = np.diff(command, 2)[LAGS - 1 :]
    there = np.flatnonzero(np.isfinite(bent))
    there = there[:: len(there) // 10_000 + 1]  # so many samples are looked at
    for speed in SPEEDS:
        dry = (2.0 / np.pi * np.arctan(v / speed) for v in (velocity, smooth))
        bends = [np.diff(law, 2) for law in (*dry, np.sign(smooth), velocity, smooth, position)]
        x = np.stack([bend[LAGS - 1 - lag : len(bend) - lag][there] for bend in bends for lag in range(LAGS)], axis=1)
        known = np.isfinite(x).all(axis=1)
        x, y = x[known], bent[there][known]
        if len(y) < FEWEST:
            continue
        scale = np.maximum(x.std(axis=0), 1e-12)
        x = x / scale
        gram, side, power = x.T @ x, x.T @ y, float(y @ y)
        inverse = np.linalg.pinv(gram, hermitian=True)
        without = power - float(side[LAGS:] @ np.linalg.pinv(gram[LAGS:, LAGS:], hermitian=True) @ side[LAGS:])
        whole = power - float(side @ inverse @ side)
        share = 1.0 - whole / max(without, 1e-300)
        values = inverse @ side / scale
        spread = inverse / np.outer(scale, scale) * whole / len(y)
        torque, error = float(values[:LAGS].sum()), float(np.sqrt(max(spread[:LAGS, :LAGS].sum(), 0.0)))
        sure = torque > max(SURE * error, SLIGHT * float(np.nanstd(command)))
        if share > max(FOLLOWS, best[0] if best else 0.0) and sure:
            best = share, torque, float(values[VISCOUS : VISCOUS + LAGS].sum())
    return best[1:] if best else None


@dataclass(frozen=True)
class _Friction:
    """Friction of a joint in one recording: torque that opposes the motion, at its mean speed [N·m]."""

    recording: str
    row: Row
    torque: float
    error: float
    """Standard error, from blocks of time [N·m]."""


def find_compensations(estimate: EffectEstimate, sets: Sequence[ResidualSet]) -> list[Compensation]:
    """Recordings in which joints have none of the friction that most others show, or drive themselves on.

    It must be more than half of the joints that show friction at all: a controller compensates an arm's, and one joint
    alone may have too little motion, or a load that was taken for it.
    """
    every = [one for data in sets for one in _frictions(estimate, data)]
    out: dict[tuple[str, str], Compensation] = {}
    shown: dict[str, set[Row]] = {}
    for one in every:
        others = [other.torque for other in every if other.row == one.row and other.recording != one.recording]
        usual = float(np.median(others)) if others else 0.0
        margin = max(data.margin[one.row] for data in sets)
        if max(usual, abs(one.torque)) > margin:
            shown.setdefault(one.recording, set()).add(one.row)
        lacks = usual > margin and one.torque < LEAST_SHARE * usual
        if (lacks or one.torque < -margin) and max(usual, 0.0) - one.torque > CLEAR * one.error:
            name, beside = sets[0].signals[0].arm.names[one.row[1]], usual if others else None
            out[one.recording, name] = Compensation(one.recording, name, one.row[0], False, one.torque, usual=beside)
    lacking = [recording for recording, _ in out]
    return [each for each in out.values() if 2 * lacking.count(each.recording) > len(shown[each.recording])]


def _frictions(estimate: EffectEstimate, data: ResidualSet) -> list[_Friction]:
    """Friction of each joint in each recording, all other effects as estimated."""
    links = tuple(term for term in estimate.terms if not term.effect.startswith("friction."))
    known = estimate.predict(data, terms=links)
    out = []
    for s, part in zip(data.signals, data.parts, strict=True):
        moved = np.array([s.filtered(each) for each in (s.q, s.v, s.a, s.direction)])
        for row in data.rows:
            if row[0] == data.layout.sensor or data.layout.reference(row):
                continue
            valid = data.valid[row][part]
            direction = moved[3, valid, row[1]]
            if len(direction) < FEWEST_MOVING or max(direction) < 0.5 or min(direction) > -0.5:
                continue  # of a joint that goes one way, friction is a constant as any other
            y = (data.values[row] - known[row])[part][valid]
            out.append(_friction(s, row, y, moved[:, valid, row[1]], data.blocks[part][valid]))
    return out


def _friction(s: PreparedSignals, row: Row, y: Array, moved: Array, blocks: NDArray[np.intp]) -> _Friction:
    """Friction from one recording's residual `y` (k,), beside what rigid links may leave; `moved` are position,
    velocity, acceleration and direction of the joint, (4, k)."""
    q, v, a, direction = moved
    x = np.stack([direction, v, np.ones_like(q), np.sin(q), np.cos(q), a], axis=1)
    scale = np.sqrt(np.mean(x**2, axis=0)) + 1e-12
    inverse = np.linalg.pinv((x / scale).T @ (x / scale), rcond=1e-8, hermitian=True)
    values = inverse @ ((x / scale).T @ y)
    rest = y - x / scale @ values
    scores = np.zeros((int(blocks.max()) + 1, x.shape[1]))
    np.add.at(scores, blocks, x / scale * rest[:, None])
    at = np.array([1.0, np.mean(np.abs(v)), 0.0, 0.0, 0.0, 0.0]) / scale
    spread = inverse @ (scores.T @ scores) @ inverse
    own = s.arm.frictionloss[row[1]] + s.arm.damping[row[1]] * np.mean(np.abs(v))  # the model's, which `y` lacks
    return _Friction(s.label, row, float(at @ values + own), float(np.sqrt(at @ spread @ at)))
