"""The rows' times and positions: jitter of receipt, rows that repeat or are missing, positions held over several."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from armlink.recording.corrections import TIME_UNITS, Corrections
from armlink.recording.recording import Recording, slice_rows
from gcomp.arrays import Array, Mask
from sim_gap.checks.finding import RecordingFinding
from sim_gap.residuals.preprocess import at_times

JITTER = 0.2
"""Standard deviation of the steps over their median from which the times may be those of receipt."""
LONG, HALF, CLEAR = 1.5, 12, 8.0
"""Step in periods from which samples may be missing in it; half the number of rows whose median tells; how much later
than before that is, in median absolute deviations, from which some are."""
SMOOTHER = 0.7
"""Roughness of the positions on even times over that on the recorded ones, below which the recorded are of receipt."""
REPEATED = 0.03
"""Share of repeated rows in motion from which a recording is said to repeat."""
DROPPED, EVEN, NEAR = 0.05, 0.95, 0.25
"""Share of missing samples from which they are said to be; share of the steps that must be within `NEAR` of a whole
number of periods, or the rate changed and nothing is missing."""

CREEP, TRAVEL = 0.02, 0.5
"""Speed that no joint reaches [rad/s] although one travels so far [rad] if the times are in a smaller unit; the slowest
joint that travels in 53 recordings of real arms reaches twenty times as much."""


def find_time_unit(recording: Recording, stated: Corrections) -> RecordingFinding | None:
    """Times in milliseconds or less, by which arms that travel would do nothing but creep."""
    if "t" in stated.units or recording.t.size < 50:
        return None
    ahead = 2 * HALF
    far = np.abs(recording.position[ahead:] - recording.position[:-ahead])
    time = recording.t[ahead:] - recording.t[:-ahead]
    travel = float(np.nanmax(np.nanmax(recording.position, axis=0) - np.nanmin(recording.position, axis=0)))
    fastest = float(np.nanmax(far / time[:, None]))
    if travel < TRAVEL or fastest > CREEP:
        return None
    unit = next((unit for unit, seconds in TIME_UNITS.items() if fastest / seconds > CREEP), "ns")
    evidence = (
        f"the joints travel {travel:.2g} rad in {np.ptp(recording.t):.3g} s, but none is faster than "
        f"{fastest:.2g} rad/s, which is too slow to be true: are the times in {unit}?"
    )
    return RecordingFinding("clock", "t", "all", evidence, f"--units t={unit}, or t=s if this is right", False)


def even_times(recording: Recording, stated: Corrections) -> tuple[Recording, list[RecordingFinding]]:
    """The recording on the sample times that its times of receipt scatter about, if they do."""
    if "t" in stated.clock or recording.t.size < 50:
        return recording, []
    steps = np.diff(recording.t)
    period = _period(recording.t)
    if float(np.std(np.clip(steps, 0.0, 5.0 * period))) < JITTER * period:
        return recording, []
    sampled = _sample_times(recording.t)
    if sampled is None:
        return recording, []
    before, after = (_roughness(t, recording.position) for t in (recording.t, sampled))
    if after > SMOOTHER * before:
        return recording, []
    scatter = float(np.std(recording.t - sampled))
    evidence = (
        f"the time steps scatter by {scatter * 1e3:.1f} ms, and with even steps of "
        f"{1e3 * float(np.median(np.diff(sampled))):.2f} ms the positions are "
        f"{before / max(after, 1e-12):.1f} times smoother: t is the time of receipt, not of measurement"
    )
    found = RecordingFinding("jitter", "t", "all", evidence, "--clock t=0 (to keep the times)", True)
    return replace(recording, t=sampled), [found]


def _sample_times(t: Array) -> Array | None:
    """Even times that the stamps scatter about, gaps kept; None where they do not scatter about even times."""
    number = np.arange(t.size) + _missed(t)
    period, start = np.polyfit(number, t, 1)
    even = start + period * number
    scatter = t - even
    wander = np.corrcoef(scatter[1:], scatter[:-1])[0, 1]
    if np.std(scatter) > 2.0 * period or wander > 0.9 or np.any(np.diff(even) <= 0.0):
        return None
    return np.asarray(even)


def _period(t: Array) -> float:
    """Time from row to row [s], by the median over many, for rows that wait in a buffer are received together."""
    ahead = min(2 * HALF, t.size - 1)
    return float(np.median(t[ahead:] - t[:-ahead])) / ahead


def _missed(t: Array) -> Array:
    """Number of samples missing before each row (K,).

    By whole periods the rows after a gap come later than those before it, each by the median of some, for any one may
    be received late; of the steps about such a place, the longest are the gaps.
    """
    rows, steps, period = np.arange(t.size), np.diff(t), _period(t)
    late = median_filter(t / period - rows, size=2 * HALF + 1, mode="nearest")
    before, after = late[np.maximum(rows[:-1] - HALF, 0)], late[np.minimum(rows[1:] + HALF, t.size - 1)]
    jump = after - before
    spread = float(np.median(np.abs(jump - np.median(jump))))
    places = np.flatnonzero(jump > max(0.5, CLEAR * spread))
    missed = np.zeros(t.size)
    for around in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if places.size else ():
        left = round(float(after[around[-1]] - before[around[0]]))
        for k in around[np.argsort(-steps[around])].tolist():
            if left <= 0 or steps[k] < LONG * period:
                break
            missed[k + 1] = min(left, max(1, round(steps[k] / period) - 1))
            left -= int(missed[k + 1])
    return np.asarray(np.cumsum(missed))


def _roughness(t: Array, position: Array) -> float:
    """Sum over the joints of the median departure of each position from the line through its neighbours."""
    filled = position[np.isfinite(position).all(axis=1)]
    own = t[np.isfinite(position).all(axis=1)]
    share = ((own[1:-1] - own[:-2]) / (own[2:] - own[:-2]))[:, None]
    line = filled[:-2] + share * (filled[2:] - filled[:-2])
    moving = np.abs(filled[2:] - filled[:-2]) > 1e-9
    off = np.where(moving, np.abs(filled[1:-1] - line), 0.0)
    spread = filled.std(0) + 1e-12
    return float((np.sqrt(np.mean(off**2, axis=0)) / spread).sum())


def drop_repeats(recording: Recording) -> tuple[Recording, list[RecordingFinding]]:
    """The recording without rows that repeat the one before while the arm moves."""
    same = _repeats(np.column_stack(list(recording.channels().values())))
    moving = fast_rows(recording.position)
    share = float(same[moving].mean()) if moving.any() else 0.0
    if share < REPEATED:
        return recording, []
    evidence = (
        f"{share:.0%} of the rows in motion repeat the row before in every channel, so old messages were read again"
    )
    kept = slice_rows(recording, ~(same & moving))
    return kept, [RecordingFinding("duplicate", "t", "all", evidence, "record each message once", True)]


def find_dropped(recording: Recording) -> list[RecordingFinding]:
    """Samples of an even clock that are missing; the others keep their times."""
    steps = np.diff(recording.t)
    if steps.size < 50:
        return []
    short = steps[steps < 1.5 * float(np.quantile(steps, 0.1))]
    periods = steps / float(np.mean(short)) if short.size else np.ones_like(steps)
    whole = np.maximum(np.round(periods), 1.0)
    missing = float((whole - 1.0).sum() / whole.sum())
    if missing < DROPPED or np.mean(np.abs(periods - whole) < NEAR) < EVEN:
        return []
    evidence = f"{missing:.0%} of the samples are missing, up to {whole.max() - 1.0:.0f} in a row"
    return [
        RecordingFinding("dropped", "t", "all", evidence, "record every message (the gaps were interpolated)", True)
    ]


def fast_rows(position: Array) -> Mask:
    """Rows at which some joint travels at least three of its smallest steps a row, over ten rows, (K,)."""
    span = 5
    fast = np.zeros(len(position), bool)
    for q in position.T:
        steps = np.abs(np.diff(q))
        steps = steps[np.isfinite(steps) & (steps > 1e-9)]
        if steps.size:
            quantum = max(float(np.quantile(steps, 0.02)), 1e-6)
            fast[span:-span] |= np.abs(q[2 * span :] - q[: -2 * span]) > 2 * span * 3.0 * quantum
    return fast


HELD = 0.3
"""Share of the rows in fast motion that repeat all positions, from which they are held."""


def drop_held(recording: Recording) -> tuple[Recording, list[RecordingFinding]]:
    """The recording with positions that were read less often than the rows come, and repeated, filled in between."""
    fast = fast_rows(recording.position)
    same = _repeats(recording.position) & fast
    share = float(same.sum()) / max(float(fast.sum()), 1.0)
    if share < HELD:
        return recording, []
    velocity, known = recording.velocity, np.repeat(~same[:, None], recording.n, axis=1)
    if velocity is not None and np.mean(_repeats(velocity)[same]) > 0.5:
        velocity = at_times(recording.t, recording.t, velocity, known)
    position = at_times(recording.t, recording.t, recording.position, known)
    evidence = (
        f"the positions repeat in {share:.0%} of the rows in motion while torques change, so they are read less "
        "often; the values between were interpolated"
    )
    found = RecordingFinding("duplicate", "q", "all", evidence, "record at the rate at which positions are read", True)
    return replace(recording, position=position, velocity=velocity), [found]


def _repeats(values: Array) -> Mask:
    """Rows in which all columns repeat the row before, (K,)."""
    return np.concatenate([[False], np.all((values[1:] == values[:-1]) | ~np.isfinite(values[1:]), axis=1)])
