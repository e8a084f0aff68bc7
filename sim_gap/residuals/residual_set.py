"""Residuals of a set of recordings: one row per channel and joint, with its noise floor, valid samples and folds.

When a gear with play changes sides, the residual jumps as no smooth effect does, in several joints. No inverse form
follows such an impact: its samples are left out of the comparison, and the impacts are reported.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from gcomp.arrays import Array, Mask
from sim_gap.residuals.layout import FLOOR, FLOOR_INNER, FLOOR_NM, ChannelLayout, Row, layout_of
from sim_gap.residuals.preprocess import PreparedSignals

BEFORE_S, AFTER_S = 0.4, 0.6
"""Time left out before and after a change of sign of the torque [s]."""
SHARP = 25.0
"""Least ratio of the residual's second difference (RMS) near these changes to that elsewhere."""
LEAST_LEFT = 0.2
"""Share of a recording that must remain."""
EXPLAINED = 0.3
"""Largest share of the RMS of the gap, above the noise, that remains in an explained diagnosis."""


def near_impacts(s: PreparedSignals, channel: str, residual: Array) -> dict[int, Mask]:
    """Joints whose gear hits at their torque reversals, and the samples near those, (k,) each, from the residual (k, n)
    of the link-side sensor `channel`."""
    torque = s.filtered(s.reading[channel])
    before, after = (round(seconds * s.rate / s.step) for seconds in (BEFORE_S, AFTER_S))
    out = {}
    for joint in range(s.n):
        near = np.zeros(len(torque), bool)
        for k in np.flatnonzero(np.diff(np.sign(torque[:, joint])) != 0).tolist():
            near[max(0, k - before) : k + after + 1] = True
        bend = np.zeros(len(torque))
        bend[1:-1] = np.diff(residual[:, joint], 2) ** 2
        if near.any() and (~near).mean() > LEAST_LEFT and bend[near].mean() > SHARP**2 * bend[~near].mean():
            out[joint] = near
    return out


MODEL_FLOOR = 1e-3
"""Numerical and geometrical error granted to every model, as a share of its torque."""
SLIGHT_NM = 0.08
"""Torque that noise and the small friction of every arm can explain [N·m]."""
RELEVANT_NM = 0.05
"""Smallest gap that is relevant to a user [N·m]: every arm has a few hundredths of friction and offset."""
SMALL_ARM_NM = 3.0
"""RMS torque of an arm's strongest joint below which bounds in N·m shrink in proportion: on a hobby servo a few
hundredths are a tenth of all it does."""
RELEVANT, RELEVANT_INNER, RELEVANT_COMMAND = 0.016, 0.007, 0.001
"""Smallest relevant gap as a share of the joint's torque (RMS): against the model, motor against sensor, command
against motor."""
FEWEST = 25
"""Samples from which a row is looked at, or a regime of it."""
FOLDS = 6
"""Number of folds for cross-validation, of all recordings together."""
MOVING_SHARE = 0.95
"""A sample of the motor row counts if the joint moves during this share of the filter's window."""
SETTLE_S, SETTLED_LEAST = 0.08, 0.4
"""Time left out before and after rest and reversal [s], if at least this share of the motion remains."""
BLOCK_S = 2.0
"""Length of the blocks within which errors may be correlated, for confidence intervals [s]."""


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """Recordings with a common layout. Arrays are at the decimated rate, recordings concatenated."""

    signals: tuple[PreparedSignals, ...]
    layout: ChannelLayout

    @property
    def rows(self) -> tuple[Row, ...]:
        return self.layout.rows

    @cached_property
    def lengths(self) -> tuple[int, ...]:
        """Number of samples of each recording."""
        return tuple(len(s.filtered(s.t)) for s in self.signals)

    @property
    def parts(self) -> list[slice]:
        return [
            slice(end - length, end) for end, length in zip(np.cumsum(self.lengths).tolist(), self.lengths, strict=True)
        ]

    @cached_property
    def time(self) -> Array:
        """Time since the start of each recording [s], (K,)."""
        return np.concatenate([s.sampled(s.t) for s in self.signals])

    @cached_property
    def values(self) -> dict[Row, Array]:
        """Reading minus its reference [N·m], (K,) per row."""
        return {row: np.concatenate([one[row] for one in self._stacked]) for row in self.rows}

    @cached_property
    def _stacked(self) -> list[dict[Row, Array]]:
        return [self._differences(s) for s in self.signals]

    def _differences(self, s: PreparedSignals) -> dict[Row, Array]:
        layout = self.layout
        out: dict[Row, Array] = {}
        joints = s.arm.nominal_joint_torque(s.v, s.a, s.direction)
        for channel in (layout.sensor, layout.motor, layout.command):
            if channel is None:
                continue
            against = s.model if channel == layout.sensor else s.model + joints
            if channel == layout.motor and layout.sensor:
                against = s.reading[layout.sensor] + joints
            if channel == layout.command and layout.motor:
                against = s.reading[layout.motor]
            difference = s.filtered(s.reading[channel] - against)
            out |= {(channel, j): difference[:, j] for j in range(layout.n)}
        return layout.compared(out)

    @cached_property
    def impacts(self) -> dict[int, Mask]:
        """Joints whose gear hits at torque reversals, and the samples near those, (K,) each."""
        sensor, out = self.layout.sensor, dict[int, Mask]()
        for s, part in zip(self.signals, self.parts, strict=True) if sensor else ():
            rest = np.stack([self.values[str(sensor), j][part] for j in range(self.layout.n)], axis=1)
            for joint, near in near_impacts(s, str(sensor), rest).items():
                row = (str(sensor), joint)
                if root_mean_square(rest[near, joint]) < self.margin[row] - 2.0 * self.floor[row]:
                    continue
                out.setdefault(joint, np.zeros(sum(self.lengths), bool))[part] = near
        return out

    @cached_property
    def valid(self) -> dict[Row, Mask]:
        """Samples that count: read, away from gear impacts, and in motion for the motor row, (K,) per row."""
        sliding = np.concatenate([slides_steadily(s) for s in self.signals])
        out = {}
        for (channel, joint), there in self.read.items():
            rubs = channel == self.layout.motor or (channel == self.layout.command and self.layout.beyond(joint) > 0)
            out[channel, joint] = there & self.calm & (sliding[:, joint] | (not rubs))
        return out

    @cached_property
    def read(self) -> dict[Row, Mask]:
        """Samples at which a row's channel and its reference were read and not interpolated, (K,) per row."""
        known = {
            channel: np.concatenate([s.filtered(s.known[channel]) for s in self.signals]) > 0.9
            for channel in (self.layout.sensor, self.layout.motor, self.layout.command)
            if channel
        }
        channels = {row: filter(None, (row[0], self.layout.reference(row))) for row in self.rows}
        return {row: np.all([known[name][:, row[1]] for name in names], axis=0) for row, names in channels.items()}

    @cached_property
    def calm(self) -> Mask:
        """Samples away from impacts of gears, (K,)."""
        return np.asarray(~np.any([np.zeros(sum(self.lengths), bool), *self.impacts.values()], axis=0))

    @cached_property
    def floor(self) -> dict[Row, float]:
        """Noise floor of each row [N·m]: sensor noise, noise of the differentiated position, model error."""
        both = list(zip(self.signals, self._stacked, strict=True))
        return {row: float(np.mean([self._floor(s, row, rest[row]) for s, rest in both])) for row in self.rows}

    @cached_property
    def relevance_floor(self) -> dict[Row, float]:
        """Residual of each row below which no effect is searched for [N·m]: noise and a small share of the torque."""
        small = {row: FLOOR if row[0] == self.layout.against_model else FLOOR_INNER for row in self.rows}
        parts = {
            row: (self.floor[row], small[row] * self.usual_torque[row[1]], self.least(FLOOR_NM)) for row in self.rows
        }
        return {row: float(np.linalg.norm(part)) for row, part in parts.items()}

    @cached_property
    def usual_torque(self) -> Array:
        """RMS model torque of each joint in the recording with the largest [N·m], (n,)."""
        return np.asarray(np.max([np.sqrt(np.mean(s.model**2, axis=0)) for s in self.signals], axis=0))

    @property
    def relevant_nm(self) -> float:
        """Smallest gap of this arm that is relevant [N·m]."""
        return self.least(RELEVANT_NM)

    def least(self, torque: float) -> float:
        """A bound in N·m as it applies to an arm of this strength."""
        return torque * min(1.0, float(self.usual_torque.max()) / SMALL_ARM_NM)

    def background(self, torque: Array | float) -> Array | float:
        """A standard deviation over sound arms in N·m, as it applies to an arm of this build.

        A large arm that gravity hardly loads, its axes being upright, has the friction of a large one.
        """
        build = max(float(self.usual_torque.max()), self.signals[0].arm.stretched_torque)
        return torque * min(1.0, build / SMALL_ARM_NM)

    def _floor(self, s: PreparedSignals, row: Row, rest: Array) -> float:
        channel, joint = row
        reference = self.layout.reference(row)
        noise = float(np.linalg.norm([s.noise[name][joint] for name in (channel, reference) if name]))
        inner = channel == self.layout.command and not self.layout.beyond(joint)
        model = 0.0 if inner else MODEL_FLOOR * float(np.sqrt(np.mean(s.model[:, joint] ** 2)))
        return float(np.hypot(min(noise, float(s.upper_half(rest))), model)) + 1e-6

    @cached_property
    def folds(self) -> NDArray[np.intp]:
        """Cross-validation fold of each sample: contiguous stretches of time, (K,).

        Several recordings have two each at least: a body that only one has must be predicted from its other part.
        """
        total, out, first = sum(self.lengths), [], 0
        for length in self.lengths:
            count = max(min(2, len(self.lengths)), round(FOLDS * length / total))
            out.append(first + np.minimum(np.arange(length) * count // length, count - 1))
            first += count
        return np.concatenate(out)

    @cached_property
    def blocks(self) -> NDArray[np.intp]:
        """Block of each sample: stretches of BLOCK_S, (K,)."""
        out, first = [], 0
        for s, length in zip(self.signals, self.lengths, strict=True):
            own = (np.arange(length) * s.step / s.rate // BLOCK_S).astype(np.intp)
            out.append(first + own)
            first += int(own[-1]) + 1
        return np.concatenate(out)

    @cached_property
    def margin(self) -> dict[Row, float]:
        """RMS of each row from which it is a gap [N·m]: twice the noise floor plus the smallest relevant gap.

        That is smaller for the motor against the sensor, in which errors of the links do not show.
        """
        torque, least = self.usual_torque, self.relevant_nm
        return {row: 2.0 * self.floor[row] + max(self.relevant(row) * torque[row[1]], least) for row in self.rows}

    def relevant(self, row: Row) -> float:
        """Smallest relevant gap in this row, as a share of the joint's torque."""
        reference = self.layout.reference(row)
        if reference is None:
            return RELEVANT
        command = (row[0], reference) == (self.layout.command, self.layout.motor)
        return RELEVANT_COMMAND if command else RELEVANT_INNER


def residual_sets(
    train: Sequence[PreparedSignals], heldout: Sequence[PreparedSignals]
) -> tuple[ResidualSet, ResidualSet]:
    """Residuals of the training and of the held-out recordings, in a common layout."""
    layout = layout_of([*train, *heldout])
    return ResidualSet(tuple(train), layout), ResidualSet(tuple(heldout), layout)


def slides_steadily(s: PreparedSignals) -> Mask:
    """Samples at which each joint slides before and after, so that its friction is fully developed, (k, n).

    Around rest and reversals friction builds up over some distance. If a joint hardly does anything else, these samples
    are kept.
    """
    moving = s.filtered(s.moving) > MOVING_SHARE
    width = 2 * round(SETTLE_S * s.rate / s.step) + 1
    settled = minimum_filter1d(moving.astype(np.uint8), width, axis=0, mode="nearest") > 0
    enough = settled.mean(0) >= SETTLED_LEAST * moving.mean(0)
    return np.where(enough, settled, moving)


def root_mean_square(x: Array) -> float:
    """Root of the mean square; NaN for an empty array."""
    return float(np.sqrt(np.mean(x**2))) if len(x) else float("nan")


# ---- where the gap is: joint, channel, and the regime of motion that it correlates with

CLEAR = 0.25
"""Share of the squared residual below which no regime is named."""


@dataclass(frozen=True)
class Location:
    """Gap of one row: RMS and noise [N·m], and the regime with the largest share of its mean square."""

    joint: str
    channel: str
    regime: str
    rms: float
    noise: float
    share: float
    hz: float | None = None
    """Frequency of a line above the pass band."""
    clear: bool = False
    """Beside the comparison: whether it exceeds what is known to be there."""


def locate(
    data: ResidualSet, left: dict[Row, Array] | None = None, rows: Sequence[Row] | None = None
) -> list[Location]:
    """Every row (or those of `rows`) with its regime, by descending ratio of RMS to noise.

    `left` replaces the residuals by what remains of them, (K,) per row.
    """
    values = data.values if left is None else left
    features = [_features(s) for s in data.signals]
    out = []
    for row in data.rows if rows is None else rows:
        channel, joint = row
        valid = data.valid[row]
        if valid.sum() < 10:
            continue
        residual = values[row][valid]
        regime, share = _regime(
            residual, {k: np.concatenate([f[k][:, joint] for f in features])[valid] for k in features[0]}
        )
        name = data.signals[0].arm.names[joint]
        out.append(Location(name, channel, regime, root_mean_square(residual), data.floor[row], share))
    return sorted(out, key=lambda location: -location.rms / max(location.noise, 1e-9))


def _features(s: PreparedSignals) -> dict[str, Array]:
    """Columns by regime, filtered, (K, n, p)."""
    t = np.broadcast_to((s.t / max(float(s.t[-1]), 1.0))[:, None], s.q.shape)
    near_reversal = np.exp(-((s.v / 0.05) ** 2))
    families = {
        "position": (s.q, s.q**2, np.sin(s.q), np.cos(s.q)),
        "velocity": (s.direction, s.v),
        "reversal": (near_reversal, near_reversal * np.sign(s.a)),
        "acceleration": (s.a,),
        "load": (s.model, s.direction * np.abs(s.model)),
        "time": (t, t**2, t**3),
    }
    return {name: s.filtered(np.stack(columns, axis=-1)) for name, columns in families.items()}


def _regime(residual: Array, features: dict[str, Array]) -> tuple[str, float]:
    total = float(np.mean(residual**2)) + 1e-300
    rest = residual - residual.mean()
    shares = {"constant": float(residual.mean() ** 2) / total}
    for name, columns in features.items():
        x = columns - columns.mean(0)
        x = x / np.maximum(np.sqrt((x**2).mean(0)), 1e-12)
        fitted = x @ np.linalg.lstsq(x, rest, rcond=1e-6)[0]
        shares[name] = float(np.mean(fitted**2)) / total
    best = max(shares, key=lambda name: shares[name])
    return (best, shares[best]) if shares[best] >= CLEAR else ("other", 1.0 - shares[best])


def row_rms(data: ResidualSet, left: dict[Row, Array] | None = None) -> dict[Row, float]:
    """RMS of each row with valid samples [N·m]; of `left` if given, else of the raw residual."""
    values = data.values if left is None else left
    return {row: root_mean_square(values[row][data.valid[row]]) for row in data.rows if data.valid[row].any()}


def by_joint(data: ResidualSet, levels: dict[Row, float]) -> Array:
    """Levels of the rows (RMS, noise floor, margin) per joint: root of the sum of squares over its channels, (n,)."""
    squares = np.zeros(data.layout.n)
    for row in data.rows:
        if data.valid[row].any():
            squares[row[1]] += levels[row] ** 2
    return np.asarray(np.sqrt(squares))
