"""Columns of foreign tables: which of them hold the channels, as a `--map` ready to paste."""

import re
from collections import defaultdict
from collections.abc import Sequence

TIMES = ("t", "time", "timestamp", "stamp", "sec", "secs", "seconds", "time_s", "t_s")
STEMS = {
    "q_cmd": (
        "target_q",
        "q_target",
        "q_cmd",
        "q_des",
        "q_ref",
        "command",
        "cmd",
        "desired",
        "goal",
        "setpoint",
        "action",
    ),
    "dq": ("actual_qd", "velocity", "velocities", "vel", "qd", "dq", "speed", "qdot", "q_dot"),
    "tau_motor": ("actual_current", "current", "motor_torque", "tau_motor", "motor_effort", "load"),
    "tau_cmd": ("target_torque", "tau_cmd", "torque_cmd", "commanded_torque"),
    "tau": ("torque", "effort", "tau", "torques", "efforts"),
    "q": ("actual_q", "position", "positions", "pos", "angle", "angles", "joint", "state", "q"),
    "temp": ("temperature", "temperatures", "temp"),
}
"""Channel → words that name it, the most telling first; the channels in the order in which they are tried."""


LONGEST_NAME, LONGEST_MAP = 60, 2000
"""Characters beyond which a name is none that a person gave, and a suggestion none to paste."""


def suggested_map(header: Sequence[str]) -> str:
    """A `--map` option for a table's header row, or empty where no position can be recognised."""
    groups: dict[tuple[str, str], list[tuple[int | str, str]]] = defaultdict(list)
    time = next((column for column in header if _plain(column) in TIMES), "")
    for column in header:
        if column == time or len(column) > LONGEST_NAME:
            continue
        stem, key = _parts(column)
        for channel, words in STEMS.items():
            word = next((word for word in words if word in stem), None)
            if word:
                groups[channel, stem].append((key, column))
                break
    chosen: dict[str, list[tuple[int | str, str]]] = {}
    for (channel, _), columns in sorted(groups.items(), key=lambda item: -len(item[1])):
        chosen.setdefault(channel, columns)
    joints = len(chosen.get("q", []))
    if not joints:
        return ""
    pairs = [f"t={time or 'TIME'}"]
    for channel, columns in chosen.items():
        if len(columns) == joints:
            ordered = sorted(
                columns, key=lambda pair: (isinstance(pair[0], str), pair[0] if isinstance(pair[0], int) else 0)
            )
            pairs += [f"{channel}_{i}={column}" for i, (_, column) in enumerate(ordered, start=1)]
    text = "--map " + ",".join(f"'{pair}'" if " " in pair else pair for pair in pairs)
    return text if len(text) <= LONGEST_MAP else ""


def _plain(column: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", column.lower()).strip("_")


def _parts(column: str) -> tuple[str, int | str]:
    """Stem of a column's name without its number, and the number; without one, the channel word and the whole name."""
    plain = _plain(column)
    number = re.search(r"(?<!\d)(\d{1,9})(?!.*\d)", plain)
    if number:
        return re.sub(r"_+", "_", plain[: number.start()] + plain[number.end() :]).strip("_"), int(number.group(1))
    words = plain.split("_")
    known = {word for group in STEMS.values() for word in group}
    ends = [word for word in (words[-1], words[0]) if word in known]
    return (ends[0] if ends else plain), plain
