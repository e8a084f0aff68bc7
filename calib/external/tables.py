"""External torque and wrench over time as tables and answers."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armlink.content.atomic_file import write_whole
from armlink.errors import BadInput
from armlink.extras import require_extra
from calib.external.listening import Heard
from gcomp.arrays import Array
from gcomp.external.contact import ContactEvent
from gcomp.external.external_model import NORMAL_95

AXES = ("x", "y", "z")
NOT_FELT = 1e5
"""Force that no arm of ours would feel [N]: a direction of which it is needed is not determined."""


def answer_of(label: str, heard: Sequence[Heard], names: tuple[str, ...]) -> dict[str, Any]:
    """A recording's part of the answer `armlink.external/1`."""
    n = len(names)
    external = np.concatenate([each.judged.external for each in heard]) if heard else np.empty((0, n))
    std = np.concatenate([each.judged.std for each in heard]) if heard else np.empty((0, n))
    moved = [np.abs(np.gradient(each.position, each.t, axis=0)).max(axis=1) for each in heard if len(each.t) > 1]
    rest = np.concatenate(moved) < 0.01 if moved else np.empty(0, bool)
    best = np.concatenate([each.least_force[0] for each in heard]) if heard else np.empty(0)
    worst = np.concatenate([each.least_force[1] for each in heard]) if heard else np.empty(0)
    return {
        "recording": label,
        "seconds": float(sum(each.t[-1] - each.t[0] for each in heard)),
        "rms": _listed(np.sqrt(np.mean(external**2, axis=0))) if len(external) else [None] * n,
        "bound": _listed(NORMAL_95 * np.median(std, axis=0)) if len(std) else [None] * n,
        "bound_at_rest": _listed(NORMAL_95 * np.median(std[rest], axis=0)) if rest.any() else [None] * n,
        "smallest_force": [_felt(best), _felt(worst)],
        "load": _listed(heard[-1].load) if heard else [0.0] * 4,
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


def columns_of(heard: Heard) -> dict[str, Array]:
    """Column name → values (S,); NaN where a wrench is not determined."""
    columns = {"t": heard.t}
    for prefix, values in (("tau_ext", heard.judged.external), ("tau_ext_std", heard.judged.std)):
        columns |= {f"{prefix}_{j + 1}": values[:, j] for j in range(values.shape[1])}
    told = heard.wrench
    std = np.sqrt(np.diagonal(told.covariance, axis1=1, axis2=2))
    for k, axis in enumerate(AXES):
        columns |= {
            f"force_{axis}": told.value[:, k], f"force_{axis}_std": np.where(told.determined[:, k], std[:, k], np.nan),
            f"moment_{axis}": told.value[:, 3 + k],
            f"moment_{axis}_std": np.where(told.determined[:, 3 + k], std[:, 3 + k], np.nan),
            f"point_force_{axis}": told.force[:, k], f"point_force_{axis}_std": told.force_std[:, k],
        }  # fmt: skip
    return columns


def save_heard(path: Path, heard: Sequence[Heard], names: tuple[str, ...], frame_id: str) -> None:
    """Write by suffix; `frame_id` names the frame whose axes a wrench is in. Raises BadInput."""
    if path.suffix == ".csv":
        parts = [columns_of(each) for each in heard]
        table = np.column_stack([np.concatenate([part[name] for part in parts]) for name in parts[0]])
        lines = [",".join("" if np.isnan(x) else f"{x:.9g}" for x in row) for row in table]
        write_whole(path, "\n".join([",".join(parts[0]), *lines]) + "\n")
        return
    if path.suffix == ".mcap":
        require_extra("--out", "bags")
        from armlink.recording.wrench_bag import save_wrench_bag

        def joined(of: Callable[[Heard], Array]) -> Array:
            return np.concatenate([of(each) for each in heard])

        save_wrench_bag(
            path, joined(lambda each: each.t), names, joined(lambda each: each.judged.external),
            joined(lambda each: each.judged.std), frame_id, joined(lambda each: each.wrench.value),
        )  # fmt: skip
        return
    raise BadInput(f"{path}: this suffix is not one of .csv, .mcap")


def _listed(values: Array) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def _felt(values: Array) -> float | None:
    """Median of a smallest force [N]; None where the direction is not determined."""
    middle = float(np.median(values)) if len(values) else np.inf
    return middle if middle < NOT_FELT else None
