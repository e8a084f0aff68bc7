"""External torque and wrench over time as tables and answers, and a picture of the smallest force that is felt."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlink.content.atomic_file import write_whole
from armlink.errors import BadInput
from armlink.extras import require_extra
from calib.external.arm_model import LONGEST_GAP
from calib.external.listening import Heard, WrenchFrame
from gcomp.arrays import Array, joined
from gcomp.external.contact import ContactDetector, ContactEvent
from gcomp.external.external_model import NORMAL_95, ExternalModel
from gcomp.external.filtered_rows import Samples
from gcomp.external.wrench import Wrench, force_found

AXES = ("x", "y", "z")
SUFFIXES = (".csv", ".mcap", ".parquet")
REST_SPEED = 0.01
"""Speed of the fastest joint below which the arm rests [rad/s]."""
NOT_FELT = 1e5
"""Force that no arm of ours would feel [N]: a direction of which it is needed is not determined."""


def answer_of(label: str, heard: Sequence[Heard], names: tuple[str, ...]) -> dict[str, Any]:
    """A recording's part of the answer `armlink.external/1`, of at least one stretch."""
    external, std, best, worst = (
        np.concatenate(column)
        for column in zip(*((each.judged.external, each.judged.std, *each.least_force) for each in heard), strict=True)
    )
    moved = np.concatenate([np.abs(np.gradient(each.position, each.t, axis=0)).max(axis=1) for each in heard])
    rest = moved < REST_SPEED
    return {
        "recording": label,
        "seconds": float(sum(each.t[-1] - each.t[0] for each in heard)),
        "rms": _listed(np.sqrt(np.mean(external**2, axis=0))),
        "bound": _listed(NORMAL_95 * np.median(std, axis=0)),
        "bound_at_rest": _listed(NORMAL_95 * np.median(std[rest], axis=0)) if rest.any() else [None] * len(names),
        "smallest_force": [_felt(best), _felt(worst)],
        "load": _listed(heard[-1].load),
        "events": [event_of(event, names) for each in heard for event in each.events],
    }


def event_of(event: ContactEvent, names: tuple[str, ...]) -> dict[str, Any]:
    return {
        "t": event.t,
        "told": event.told,
        "kind": event.kind,
        "joints": [names[j] for j in event.joints],
        "link": names[event.link],
        "probability": event.probability,
        "odds": event.odds,
        "least_force": event.least_force,
        "mass": event.mass,
    }


def event_text(event: dict[str, Any]) -> str:
    """Of `event_of`, for people."""
    if event["kind"] == "contact":
        told = f"at link {event['link']} ({event['probability']:.0%}), at least {event['least_force']:.1f} N"
    else:
        told = f"{event['mass']:+.2f} kg{' if it is a load' if event['kind'] == 'contact or load' else ''}"
    return f"{event['kind']} {told}; joints {', '.join(event['joints'])}"


def wrench_of(told: Wrench) -> dict[str, list[float]]:
    """Force [N] and moment [N·m] of one row with their standard deviations, NaN along axes that joints do not show."""
    value, std = told.value[0].tolist(), told.std[0].tolist()
    return {"force": value[:3], "force_std": std[:3], "moment": value[3:], "moment_std": std[3:]}


def columns_of(heard: Heard) -> dict[str, Array]:
    """Column name → values (S,); NaN where a wrench is not determined."""
    columns = {"t": heard.t}
    for prefix, values in (("tau_ext", heard.judged.external), ("tau_ext_std", heard.judged.std)):
        columns |= {f"{prefix}_{j + 1}": values[:, j] for j in range(values.shape[1])}
    told, std = heard.wrench, heard.wrench.std
    for k, axis in enumerate(AXES):
        columns |= {
            f"force_{axis}": told.value[:, k], f"force_{axis}_std": std[:, k],
            f"moment_{axis}": told.value[:, 3 + k], f"moment_{axis}_std": std[:, 3 + k],
            f"point_force_{axis}": told.force[:, k], f"point_force_{axis}_std": told.force_std[:, k],
        }  # fmt: skip
    return columns


def require_writable(path: Path) -> None:
    """Raise BadInput for a suffix that `save_heard` does not write, or if what it needs is not installed."""
    if path.suffix not in SUFFIXES:
        raise BadInput(f"--out {path}: this suffix is not one of {', '.join(SUFFIXES)}")
    if path.suffix == ".mcap":
        require_extra("--out", "bags")
    if path.suffix == ".parquet":
        require_extra("--out", "parquet")


def save_heard(path: Path, judged: Sequence[tuple[str, Array, Sequence[Heard]]], names: tuple[str, ...]) -> None:
    """Write by suffix; of each recording label, times and stretches."""
    heard = [each for *_, stretches in judged for each in stretches]
    if path.suffix == ".parquet":
        _save_observations(path, judged)
        return
    if path.suffix == ".csv":
        parts = [columns_of(each) for each in heard]
        table = np.column_stack([np.concatenate([part[name] for part in parts]) for name in parts[0]])
        lines = [",".join("" if np.isnan(x) else f"{x:.9g}" for x in row) for row in table]
        write_whole(path, "\n".join([",".join(parts[0]), *lines]) + "\n")
        return
    from armlink.recording.wrench_bag import save_wrench_bag

    columns = ((each.t, each.judged.external, each.judged.std, each.wrench.value) for each in heard)
    t, external, std, value = (np.concatenate(column) for column in zip(*columns, strict=True))
    save_wrench_bag(path, t, names, external, std, "base", value)


def _save_observations(path: Path, judged: Sequence[tuple[str, Array, Sequence[Heard]]]) -> None:
    """As LeRobot's keys, at the rows of the recordings: what was known at their time."""
    from armlink.recording.lerobot import save_observations

    episodes, times, parts = list[Array](), list[Array](), list[dict[str, Array]]()
    for number, (label, t, heard) in enumerate(judged):
        episode = label.rpartition("#")[2]
        episodes.append(np.full(len(t), int(episode) if "#" in label and episode.isdigit() else number))
        times.append(t)
        rows = {
            "external_torque": [each.judged.external for each in heard],
            "external_torque_std": [each.judged.std for each in heard],
            "external_wrench": [each.wrench.value for each in heard],
            "external_wrench_std": [each.wrench.std for each in heard],
        }
        known = np.concatenate([each.t for each in heard])
        newest = np.searchsorted(known, t + 1e-6, side="right") - 1
        fresh = (newest >= 0) & (t - known[newest] <= LONGEST_GAP)
        parts.append({name: np.where(fresh[:, None], np.concatenate(x)[newest], np.nan) for name, x in rows.items()})
    observations = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    save_observations(path, np.concatenate(episodes), np.concatenate(times), observations)


def _listed(values: Array) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _felt(values: Array) -> float | None:
    """Median of a smallest force [N]; None where the direction is not determined."""
    middle = float(np.median(values))
    return middle if middle < NOT_FELT else None


POSES, DIRECTIONS = 600, 8
"""Poses drawn over the joints' range, and directions of the force at each."""
CELLS = 24
"""Cells of the picture along either side."""
SIZE = 480
"""Side of the picture [pixels]."""
COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""From the smallest force to the largest: viridis (matplotlib)."""


def smallest_forces(model: ExternalModel, frame: WrenchFrame, per_hour: float) -> tuple[Array, Array]:
    """(Places (K, 2): distance from the first axis' origin and height against gravity [m]; forces (K,) [N]) at rest."""
    arm, random = model.arm, np.random.default_rng(1)
    low, high = (np.clip(each, -np.pi, np.pi) for each in (arm.lower, arm.upper))
    poses = random.uniform(low, high, (POSES, arm.n))
    rows = []
    for pose in poses:
        still = np.zeros((1, arm.n))
        rows.append(model.rows(model.filter(1.0).rows(Samples(pose[None], still, still, still))))
    every = joined(rows)
    detector = ContactDetector(model, per_hour, frame.point)
    std = model.sudden.std(every.state, np.zeros_like(every.left))
    ways = random.normal(size=(DIRECTIONS, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    motion = every.motion
    force = np.median([force_found(detector, motion, frame.link, frame.point, way, std) for way in ways], axis=0)
    at = motion.origin[:, frame.link] + motion.rotation[:, frame.link] @ frame.point
    up = -arm.gravity / np.linalg.norm(arm.gravity)
    height = at @ up
    return np.column_stack([np.linalg.norm(at - np.outer(height, up), axis=1), height]), np.asarray(force)


def draw_map(path: Path, places: Array, force: Array, title: str) -> None:
    """Write the picture as SVG: medians of each cell."""
    low, high = places.min(axis=0), places.max(axis=0)
    cell = np.minimum(((places - low) / np.maximum(high - low, 1e-9) * CELLS).astype(int), CELLS - 1)
    log = np.log(np.clip(force, 1e-3, 1e6))
    first, last = np.quantile(log, [0.02, 0.98])
    side = SIZE / CELLS
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{SIZE + 180}" height="{SIZE + 70}" '
        'font-family="sans-serif" font-size="13"><rect width="100%" height="100%" fill="white"/>',
        f'<text x="50" y="20">{title}</text>',
    ]
    for column in range(CELLS):
        for row in range(CELLS):
            inside = (cell[:, 0] == column) & (cell[:, 1] == row)
            if inside.any():
                colour = _colour((float(np.median(log[inside])) - first) / max(last - first, 1e-9))
                x, y = 50 + column * side, 30 + (CELLS - 1 - row) * side
                parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}" fill="{colour}"/>')
    for share in np.linspace(0.0, 1.0, len(COLOURS)):
        y = 40 + (1.0 - share) * (SIZE - 60)
        parts.append(f'<rect x="{SIZE + 70}" y="{y:.1f}" width="20" height="20" fill="{_colour(share)}"/>')
        value = float(np.exp(first + share * (last - first)))
        parts.append(f'<text x="{SIZE + 96}" y="{y + 15:.1f}">{value:.3g} N</text>')
    for x, y, text in (
        (50, SIZE + 48, f"{low[0]:.2f} m"), (SIZE, SIZE + 48, f"{high[0]:.2f} m"), (SIZE / 2 - 40, SIZE + 64, "reach"),
        (4, SIZE + 26, f"{low[1]:.2f}"), (4, 42, f"{high[1]:.2f}"), (4, SIZE / 2, "height"),
    ):  # fmt: skip
        parts.append(f'<text x="{x}" y="{y}">{text}</text>')
    write_whole(path, "\n".join([*parts, "</svg>"]) + "\n")


def _colour(share: float) -> str:
    place = float(np.clip(share, 0.0, 1.0)) * (len(COLOURS) - 1)
    k = min(int(place), len(COLOURS) - 2)
    mixed = [round(a + (place - k) * (b - a)) for a, b in zip(COLOURS[k], COLOURS[k + 1], strict=True)]
    return f"rgb({mixed[0]},{mixed[1]},{mixed[2]})"
