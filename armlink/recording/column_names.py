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
    "tau": ("torque", "effort", "tau", "torques", "efforts", "eff"),
    "q": ("actual_q", "position", "positions", "pos", "angle", "angles", "joint", "state", "q"),
    "temp": ("temperature", "temperatures", "temp"),
}
"""Channel → words that name it, the most telling first; the channels in the order in which they are tried."""


UNITS = {
    "deg": "deg",
    "degrees": "deg",
    "deg_s": "deg",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
    "mnm": "mN·m",
    "mn_m": "mN·m",
    "a": "A:K",
    "ma": "A:K",
    **dict.fromkeys(("rad", "rad_s", "s", "nm", "n_m"), ""),
}
"""Unit as a header row has it → value of `--units`, empty where the channel is in that unit anyway."""
LONGEST_NAME, LONGEST_MAP = 60, 2000
"""Characters beyond which a name is none that a person gave, and a suggestion none to paste."""


def suggested_map(header: Sequence[str]) -> str:
    """A `--map` option, and `--units`, for a table's header row; empty where no position can be recognised."""
    groups: dict[tuple[str, str], list[tuple[int | str, str]]] = defaultdict(list)
    time = next((column for column in header if _unitless(column)[0] in TIMES), "")
    for column in header:
        if column == time or len(column) > LONGEST_NAME:
            continue
        stem, key = _parts(column)
        for channel, words in STEMS.items():
            if any(word in stem for word in words):
                groups[channel, stem].append((key, column))
                break
    chosen: dict[str, list[tuple[int | str, str]]] = {}
    for (channel, _), columns in sorted(groups.items(), key=lambda item: -len(item[1])):
        chosen.setdefault(channel, columns)
    joints = len(chosen.get("q", []))
    if not joints:
        return ""
    pairs, taken = [("t", time or "TIME")], {"t": [time]}
    for channel, columns in chosen.items():
        if len(columns) == joints:
            taken[channel] = [
                column for _, column in sorted(columns, key=lambda pair: pair[0] if isinstance(pair[0], int) else 0)
            ]
            pairs += [(f"{channel}_{i}", column) for i, column in enumerate(taken[channel], start=1)]
    foreign = [f"{ours}={column}" for ours, column in pairs if ours != column]
    text = "--map " + ",".join(f"'{pair}'" if re.search(r"[ ();&]", pair) else pair for pair in foreign)
    units = [f"{channel}={unit}" for channel, columns in taken.items() if (unit := _unit(columns))]
    text += " --units " + ",".join(units) if units else ""
    return text if foreign and len(text) <= LONGEST_MAP else ""


def joint_names(columns: Sequence[str]) -> tuple[str, ...]:
    """Names of the joints that columns of one channel hold (`/joint_states/elbow/position`); empty where they do not.

    Numbers alone are no names.
    """
    keys = [_parts(column)[1] for column in columns]
    names = tuple(key for key in keys if isinstance(key, str) and re.search("[a-z]{2}", key))
    return names if names and len(set(names)) == len(columns) else ()


def _plain(column: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", column.lower()).strip("_")


def _unitless(column: str) -> tuple[str, str]:
    """A column's plain name without its unit (`time [ms]`, `q1_deg`), and the unit as it stands there."""
    bare, _, bracket = re.sub(r"[\[(]([^\])0-9]+)[\])]", r"|\1|", column).partition("|")
    if bracket:
        return _plain(bare), _plain(bracket)
    stem, _, unit = _plain(column).rpartition("_")
    return (stem, unit) if stem and len(unit) > 1 and unit in UNITS else (_plain(column), "")


def _unit(columns: Sequence[str]) -> str:
    """The value of `--units` for columns of one channel, empty where it needs none."""
    units = {UNITS.get(_unitless(column)[1], "") for column in columns}
    return units.pop() if len(units) == 1 else ""


def _parts(column: str) -> tuple[str, int | str]:
    """The word or words for the channel in a column's name, and the joint: its number, or its name.

    `actual_q_3` is `actual_q` and 3; in `wrist_3_joint_pos` the channel's word comes last (or first), and the rest is
    the name of the joint.
    """
    plain = _unitless(column)[0]
    words = plain.split("_")
    known = {word for group in STEMS.values() for word in group}
    ends = [-1] if words[-1] in known else [0] if words[0] in known and not words[-1].isdigit() else []
    for end in ends:
        rest = _after_topic(words[:-1] if end else words[1:])
        if re.search("[a-z]", rest):
            return words[end], rest
    number = re.search(r"(?<!\d)(\d{1,9})(?!.*\d)", plain)
    if number:
        return re.sub(r"_+", "_", plain[: number.start()] + plain[number.end() :]).strip("_"), int(number.group(1))
    return (words[ends[0]] if ends else plain), plain


def _after_topic(words: Sequence[str]) -> str:
    """The words of a joint's name, without the topic (`joint_states`) before it."""
    topic = next((k + 1 for k, word in enumerate(words) if word in ("states", "state")), 0)
    return "_".join(words[topic:])
