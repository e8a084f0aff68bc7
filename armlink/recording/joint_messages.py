"""Joint messages of a bag as a recording: whose joints count, and which message of another topic belongs to a row."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from armlink.arrays import Array
from armlink.errors import BadInput
from armlink.recording.recording import MOST_JOINTS, Recording
from armlink.recording.ros_joint_state import NANO

Lists = tuple[str | None, str | None, str | None]
"""Channels carried as position, velocity and effort."""
STATES = "/joint_states"
TOPICS: dict[str, Lists] = {
    STATES: ("position", "velocity", "torque"),
    "/motor_states": (None, None, "motor_torque"),
    "/joint_commands": ("position_command", None, "torque_command"),
    "/joint_temperatures": (None, None, "temperature"),
}


class JointMessage(NamedTuple):
    """One message: its stamp [ns], joint names, and the channels that it carries, each empty or a value a joint."""

    stamp: int
    names: tuple[str, ...]
    channels: Mapping[str, Sequence[float]]


def main_joints(messages: Sequence[JointMessage]) -> tuple[tuple[str, ...], list[str]]:
    """Joints of the messages that count most, and those left out, which have messages of their own (a gripper).

    Messages of the same joints in another order count on their own.
    """
    counts = Counter(message.names for message in messages)
    most = max(counts, key=lambda each: counts[each] * len(each))
    return most, sorted({name for each in counts if not set(most) <= set(each) for name in each} - set(most))


def left_out_warning(joints: Sequence[str]) -> str:
    """Warning about joints that are not read, empty if there are none."""
    return f"joints left out because they come in other messages: {', '.join(joints)}" if joints else ""


def recording_of_messages(
    main: Sequence[JointMessage],
    others: Sequence[Sequence[JointMessage]],
    names: tuple[str, ...],
    source: str,
    warning: str,
) -> Recording:
    """A row for each of the `main` messages, from the first on; those of `others` go to the row nearest in time, if
    nearer than half the median period, and are NaN elsewhere. Raises BadInput."""
    if len(names) > MOST_JOINTS:
        raise BadInput(f"{source}: {len(names)} joints in the joint states, expected at most {MOST_JOINTS}")
    stamps = np.array([message.stamp for message in main], dtype=np.int64)
    channels = _channels(main, names, source)
    for messages in others:
        times = np.array([message.stamp for message in messages], dtype=np.int64)
        for channel, values in _channels(messages, names, source).items():
            channels[channel] = _nearest_rows(values, times, stamps)
    if "position" not in channels:
        raise BadInput(f"{source}: the joint states carry no position")
    return Recording(t=(stamps - stamps[0]) / NANO, names=names, warning=warning, **channels)


def _channels(messages: Sequence[JointMessage], names: tuple[str, ...], source: str) -> dict[str, Array]:
    """Channels of some messages (K, n) in the order of `names`; NaN for joints that a message omits."""
    found: dict[str, Array] = {}
    orders: dict[tuple[str, ...], tuple[list[int], list[int]]] = {}
    for row, message in enumerate(messages):
        if message.names not in orders:
            both = [name for name in names if name in message.names]
            orders[message.names] = [names.index(n) for n in both], [message.names.index(n) for n in both]
        into, of = orders[message.names]
        for channel, values in message.channels.items():
            if not len(values):
                continue
            if len(values) != len(message.names):
                told = f"{len(values)} {channel} values of {len(message.names)} joints"
                raise BadInput(f"{source}: message {row + 1}: {told}")
            if channel not in found:
                found[channel] = np.full((len(messages), len(names)), np.nan)
            found[channel][row, into] = np.array(values)[of]
    return found


def _nearest_rows(values: Array, times: Any, stamps: Any) -> Array:
    """Values (M, n) of messages at `times` (M,), in any order, at the rows' `stamps` (K,) [ns]: (K, n)."""
    half = np.median(np.diff(stamps)) / 2 if stamps.size > 1 else 0.0
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    after = np.clip(np.searchsorted(times, stamps), 0, times.size - 1)
    before = np.clip(after - 1, 0, None)
    nearest = np.where(np.abs(times[before] - stamps) <= np.abs(times[after] - stamps), before, after)
    aligned: Array = np.where((np.abs(times[nearest] - stamps) <= half)[:, None], values[nearest], np.nan)
    return aligned
