"""Joint messages of a bag as rows: whose joints count, and which message of another topic belongs to a row."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from armlink.arrays import Array


def main_joints(names: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], list[str]]:
    """Joints of the messages that count most, and those left out, which have messages of their own (a gripper).

    `names` are the joint names of each message; messages of the same joints in another order count on their own.
    """
    counts = Counter(names)
    most = max(counts, key=lambda each: counts[each] * len(each))
    return most, sorted({name for each in counts if not set(most) <= set(each) for name in each} - set(most))


def left_out(joints: Sequence[str]) -> str:
    """Warning about joints that are not read, empty if there are none."""
    return f"joints in messages of their own, left out: {', '.join(joints)}" if joints else ""


def nearest_rows(values: Array, times: Any, stamps: Any) -> Array:
    """Values (M, n) of messages at `times` (M,), in any order, at the rows' `stamps` (K,) [ns]: (K, n).

    Each row takes the nearest message if it is nearer than half the rows' median period, else NaN.
    """
    half = np.median(np.diff(stamps)) / 2 if stamps.size > 1 else 0.0
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    after = np.clip(np.searchsorted(times, stamps), 0, times.size - 1)
    before = np.clip(after - 1, 0, None)
    nearest = np.where(np.abs(times[before] - stamps) <= np.abs(times[after] - stamps), before, after)
    aligned: Array = np.where((np.abs(times[nearest] - stamps) <= half)[:, None], values[nearest], np.nan)
    return aligned
