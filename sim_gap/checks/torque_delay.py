"""Time of a torque channel against the positions'."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from armlink.recording.corrections import Corrections
from gcomp.arrays import Array
from sim_gap.checks.finding import RecordingFinding
from sim_gap.checks.rigid_fit import FEW, FLOOR, SCREENED, ChannelMotion, fit_model, fit_models
from sim_gap.model.rigid_body import RigidArm

LAG, LAG_STEP = 1.5, 0.02
"""Longest delay that is looked for, and its step [s]."""
OWN_LAG = {"tau": (-0.03, 0.06), "tau_motor": (-0.03, 0.03), "tau_cmd": (-0.12, 0.12)}
"""Delays of a channel between which they are an effect of drive or sensor, which the diagnosis finds by itself [s]:
sensors read late, drives follow a command late, and positions are some milliseconds old."""
SURE = 0.7
"""Fall of the cost from which a delay is certain."""
SEVERAL, SURE_OF_SEVERAL = 3, 0.4
"""Number of joints whose common delay is certain with a smaller fall; sound recordings of such arms reach 0.33, with
which a link sensor's reading may truly be late, and those of one joint 0.45, as a motion that repeats looks alike."""
REPEATS, APART = 0.5, 0.12
"""Share of the fall by which any other minimum of the cost must be higher that is so far away [s]."""
SHORTEST, SHORT, SHORT_STEP = 0.02, 0.1, 0.01
"""Shortest delay that is told from elastic joints, longest one looked for between the rows, and its step [s]."""
COMMON = {"tau_motor": (0.15, 0.25), "tau": (0.2, 1.0)}
"""Fall of the cost from which such a delay is certain, and the most by which it may rise at other joints, over what it
falls by at some: motors of real arms reach 0.10, or at two joints 0.5 with rises of 0.2 and more. Link sensors, of
which one may be late, are never early: on real and simulated arms the cost falls by up to 0.08."""

ALL = 0.5
"""Least median of the joints' own delays, over the common one: play in one joint bends the torque of another alone."""


def find_delay(
    arm: RigidArm, motion: ChannelMotion, rate: float, stated: Corrections
) -> tuple[list[RecordingFinding], float]:
    """A torque channel whose clock is far off that of the positions, and by how much the cost falls with it.

    `rate` is that of the motion's rows [Hz].
    """
    if motion.channel in stated.clock:
        return [], 0.0
    model = arm.carried(motion.q, motion.v, motion.a)
    start = float(fit_model(model, motion).cost.sum())
    costs, sure = {}, SURE if arm.n < SEVERAL else SURE_OF_SEVERAL
    if start - arm.n * np.log(FLOOR) < sure:
        return [], 0.0
    for rows in np.unique(np.round(np.arange(-LAG, LAG + LAG_STEP, LAG_STEP) * rate).astype(int)):
        if abs(rows) < len(model) // 4 and start - _delayed_cost(model, motion, int(rows), FEW) > SCREENED * sure:
            costs[rows / rate] = _delayed_cost(model, motion, int(rows))
    lag = min(costs, key=costs.__getitem__, default=0.0)
    fall = start - costs.get(lag, start)
    early, late = OWN_LAG[motion.channel]
    if early <= lag <= late or abs(lag) >= LAG - 2.0 * LAG_STEP or fall < sure or _repeats(costs, lag, fall):
        return [], 0.0
    lag = _between_rows(model, motion, round(lag * rate)) / rate
    if 0.0 < lag <= late:
        return [], 0.0
    return [_clock(motion.channel, lag)], fall


def _between_rows(model: Array, motion: ChannelMotion, rows: int) -> float:
    """The delay in rows at which the cost is least, by the parabola through a minimum and its neighbours."""
    before, least, after = (_delayed_cost(model, motion, k) for k in (rows - 1, rows, rows + 1))
    bend = before - 2.0 * least + after
    return rows + (float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend > 0.0 else 0.0)


def _repeats(costs: Mapping[float, float], lag: float, fall: float) -> bool:
    """Whether the cost has another minimum nearly as low: in a motion that repeats, a delay by a period looks alike."""
    order = sorted(costs)
    values = [np.inf, *(costs[at] for at in order), np.inf]
    minima = [at for k, at in enumerate(order, start=1) if values[k] <= min(values[k - 1], values[k + 1])]
    return any(abs(at - lag) > APART and costs[at] - costs[lag] < REPEATS * max(fall, SURE) for at in minima)


def _delayed_cost(model: Array, motion: ChannelMotion, rows: int, step: int = 1) -> float:
    """Cost with the reading taken `rows` later than the motion, on every `step`-th row."""
    ahead, behind = max(0, -rows), max(0, rows)
    n = len(model) - abs(rows)
    moved = replace(
        motion,
        q=motion.q[ahead : ahead + n : step],
        v=motion.v[ahead : ahead + n : step],
        a=motion.a[ahead : ahead + n : step],
        reading=motion.reading[behind : behind + n : step],
    )
    return float(fit_model(model[ahead : ahead + n : step], moved).cost.sum())


def find_short_delay(arm: RigidArm, motion: ChannelMotion, rate: float, stated: Corrections) -> list[RecordingFinding]:
    """A delay of a row or two that all motors' torques show, or link sensors that are early: a clock's, and no drive's.

    `rate` is that of the motion's rows [Hz].
    """
    if motion.channel in stated.clock or motion.channel not in COMMON or arm.n < SEVERAL:
        return []
    lags, edge = np.arange(-SHORT, SHORT + 0.5 * SHORT_STEP, SHORT_STEP), int(np.ceil(SHORT * rate)) + 1
    if motion.channel == "tau":
        lags = lags[lags < 0.5 * SHORT_STEP]
    if len(motion.q) < 4 * edge:
        return []
    t, (least, opposed) = np.arange(len(motion.q)) / rate, COMMON[motion.channel]
    now = int(np.argmin(np.abs(lags)))
    for step in (FEW, 1):
        costs = _interpolated_costs(arm, motion, t, slice(edge, -edge, step), lags)
        best = int(np.argmin(costs.sum(1)))
        if float((costs[now] - costs[best]).sum()) < SCREENED * least:
            return []
    lag, own = float(lags[best]), float(np.median(lags[costs.argmin(axis=0)]))
    falls = costs[now] - costs[best]
    rises = float(-falls[falls < 0.0].sum())
    clear = falls.sum() >= least and rises <= opposed * (float(falls.sum()) + rises)
    if abs(lag) < SHORTEST - 1e-9 or not clear or own * lag < ALL * lag**2:
        return []
    return [_clock(motion.channel, lag)]


def _interpolated_costs(arm: RigidArm, motion: ChannelMotion, t: Array, rows: slice, lags: Array) -> Array:
    """Cost of every joint with the reading of some `rows` taken later than the motion by each of `lags` [s], (L, n).

    `t` are the times of all rows [s]. The motion is interpolated and not the reading, whose noise would be less between
    its rows.
    """
    after = t[rows] - lags[:, None]
    q, v, a = (CubicSpline(t, x)(after) for x in (motion.q, motion.v, motion.a))
    models = arm.carried(*(x.reshape(-1, arm.n) for x in (q, v, a))).reshape(q.shape)
    reading = motion.reading[rows]
    pairs = [(model, replace(motion, q=q[k], v=v[k], a=a[k], reading=reading)) for k, model in enumerate(models)]
    return np.array([fit.cost for fit in fit_models(pairs)])


def _clock(channel: str, lag: float) -> RecordingFinding:
    evidence = f"is {abs(lag):.2f} s {'late' if lag > 0 else 'early'} against the positions"
    return RecordingFinding("clock", channel, "all", evidence, f"--clock {channel}={-lag:.3f}", True)
