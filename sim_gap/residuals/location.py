"""Location of the gap: joint, channel, and the regime of motion that it correlates with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.residuals.layout import Row
from sim_gap.residuals.preprocess import PreparedSignals
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square

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
