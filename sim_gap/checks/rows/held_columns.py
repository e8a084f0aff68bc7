"""Columns of a channel that hold the motion of other joints, as an option that puts each in its place."""

from collections.abc import Mapping


def exchange_option(channel: str, holds: Mapping[int, int]) -> str:
    """The `--map` that gives every joint its column; empty where none can, since some joint's motion is in no column.

    Args:
        channel: prefix of the columns, such as `dq`.
        holds: column that is wrong → joint whose motion it holds, both from 0.
    """
    if set(holds) != set(holds.values()):
        return ""
    return "--map " + ",".join(f"{channel}_{joint + 1}={channel}_{column + 1}" for column, joint in holds.items())
