"""Signals that adapters share: filtered motion for inverse dynamics, and windows for roll-outs."""

from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from referee.interface import Case, Recorded

SEARCH_SHARE = 0.5
"""Share of the processor time that a search without an end of its own takes."""
EVEN_HZ, BAND_HZ = 100.0, 6.0
ENDS, EVERY = 50, 5
"""Rows left out at both ends, where a filter settles, and the step from row to row that is kept."""


def motion(case: Case) -> tuple[Any, Any, Any, Any]:
    """q, v, a and torque of all training recordings under one zero-phase low pass, (K, n) each."""
    parts = []
    for r in case.train:
        clock, low = np.arange(r.t[0], r.t[-1], 1.0 / EVEN_HZ), butter(4, BAND_HZ, fs=EVEN_HZ, output="sos")
        q, torque = (sosfiltfilt(low, at(clock, r.t, values), axis=0) for values in (r["q"], r.torque))
        v = np.gradient(q, 1.0 / EVEN_HZ, axis=0)
        parts.append([x[ENDS:-ENDS:EVERY] for x in (q, v, np.gradient(v, 1.0 / EVEN_HZ, axis=0), torque)])
    q, v, a, torque = (np.concatenate(column) for column in zip(*parts, strict=True))
    return q, v, a, torque


def windows(case: Case, seconds: float, count: int) -> list[tuple[Recorded, slice, Any]]:
    """About `count` windows, evenly spread: recording, its rows, and the velocities at all of its rows."""
    train, found = case.train, []
    for r in train:
        rows, speed = round(seconds / float(np.median(np.diff(r.t)))), np.gradient(r["q"], r.t, axis=0)
        starts = np.unique(np.linspace(0, len(r.t) - rows - 1, max(count // len(train), 1)).astype(int))
        found += [(r, slice(k, k + rows), speed) for k in starts.tolist()]
    return found


def drive(case: Case, r: Recorded) -> Any:
    """What drives a roll-out: commands where positions alone were recorded, else torques."""
    return r["q_cmd"] if case.kind == "positions" else r.torque


def at(clock: Any, t: Any, values: Any) -> Any:
    """Columns at other times, along straight lines."""
    return np.column_stack([np.interp(clock, t, column) for column in values.T])


def held(clock: Any, t: Any, values: Any) -> Any:
    """Columns at other times, each held until the next."""
    return values[np.clip(np.searchsorted(t, clock + 1e-9, side="right") - 1, 0, None)]
