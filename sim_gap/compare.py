"""Several models on the same recordings: what gap each leaves, and how sure it is that one leaves less.

Without a torque channel each model is moved along the commands, in windows that begin at measured positions and running
free; with one, its torque is compared in stretches of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS, Corrections
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.attribution.diagnose import checked_recordings
from sim_gap.checks.check import is_position_only
from sim_gap.checks.finding import RecordingFinding
from sim_gap.model.load import KnownGains, SimModel
from sim_gap.position_gap.fit import residuals, root_mean_squares
from sim_gap.position_gap.plant import MovedModel, nominal_point
from sim_gap.position_gap.training.export import widen_ranges
from sim_gap.position_gap.training.replay import nominal, replay_rms
from sim_gap.position_gap.training.spread import INSIDE
from sim_gap.position_gap.windows import windows_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import residual_sets

RESAMPLED = 2000
"""Samples of a bootstrap over windows (Efron and Tibshirani 1993: a thousand and more for the ends of an interval)."""


@dataclass(frozen=True, eq=False)
class ModelGap:
    """The gap that one model leaves, by joint (n,) and over all joints, RMS."""

    model: str
    windows: Array
    low: Array
    high: Array
    """Ends of the 95 % interval of `windows`."""
    overall: tuple[float, float, float]
    """RMS over all joints in windows, and its interval."""
    free: Array | None
    """Running free; None with a torque channel."""
    over_best: tuple[float, float]
    """95 % interval of its RMS over that of the best, in the same windows."""

    @property
    def alike(self) -> bool:
        """Whether these recordings do not tell it from the best by more than 1 %."""
        return self.over_best[0] <= 1.01


@dataclass(frozen=True, eq=False)
class ModelComparison:
    unit: str
    """rad or N·m."""
    names: tuple[str, ...]
    count: int
    """Windows."""
    models: tuple[ModelGap, ...]
    """The best first."""
    checks: tuple[tuple[str, RecordingFinding], ...] = ()
    """Model, and what its check of the recordings found and corrected."""

    def to_json(self) -> dict[str, Any]:
        return {
            "schema": "armlink.gap-comparison/1",
            "unit": self.unit,
            "joints": list(self.names),
            "windows": self.count,
            "checks": [{"model": model, **found.to_json()} for model, found in self.checks],
            "models": [
                {
                    "model": each.model,
                    "rms": {"value": each.overall[0], "ci95": list(each.overall[1:])},
                    "over_best_ci95": list(each.over_best),
                    "as_good_as_best": each.alike,
                    "joints": {
                        name: {
                            "windows": {"value": float(each.windows[j]), "ci95": [each.low[j], each.high[j]]},
                            "free": None if each.free is None or np.isnan(each.free[j]) else float(each.free[j]),
                        }
                        for j, name in enumerate(self.names)
                    },
                }
                for each in self.models
            ],
        }


def compare_models(
    models: Sequence[Any],
    recordings: Sequence[Recording],
    *,
    labels: Sequence[str] = (),
    stated: Corrections = AS_IT_IS,
    known_gains: KnownGains | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> ModelComparison:
    """The gap that each model leaves of the same recordings. Raises BadInput where one cannot be used."""
    labels = list(labels) or [f"recording {i + 1}" for i in range(len(recordings))]
    squares, weights, free, findings = list[Array](), list[Array](), list[Array](), list[tuple[str, RecordingFinding]]()
    names: tuple[str, ...] = ()
    for model in models:
        sim, checked, found = checked_recordings(model, recordings, labels, stated, base, tip, known_gains)
        findings += [(str(model), each) for each in found]
        if names and sim.arm.names != names:
            raise BadInput(
                f"--sim {model}: its joints are {', '.join(sim.arm.names)}, but the other models have "
                f"{', '.join(names)}"
            )
        names = sim.arm.names
        if all(is_position_only(recording) for recording in checked):
            own, weight, moved = _moved(model, sim, checked, labels)
            free.append(moved)
        else:
            own, weight = _torques(sim, checked, labels)
        squares.append(own)
        weights.append(weight)
    unit, called = "rad" if free else "N·m", [str(model) for model in models]
    return replace(_ranked(called, np.stack(squares), weights[0], free, unit, names), checks=tuple(findings))


def _moved(
    model: Any, sim: SimModel, recordings: Sequence[Recording], labels: Sequence[str]
) -> tuple[Array, Array, Array]:
    """Squares of the gap of positions and samples by joint and window (n, W), and the RMS running free (n,)."""
    sim = widen_ranges(sim, recordings)
    plant = MovedModel(sim)
    if missing := [name for name, driven in zip(sim.arm.names, plant.driven, strict=True) if not driven]:
        raise BadInput(
            f"--sim {model}: no position actuator at {', '.join(missing)}: give the gains with --gains "
            "kp=VALUE,kd=VALUE"
        )
    data = windows_of(plant, recordings, labels)
    rms = root_mean_squares(data, residuals(data, [nominal_point(plant)]))[0]
    weight = data.weight.sum(0)
    return rms**2 * weight, weight, replay_rms(nominal(sim), recordings)


def _torques(sim: SimModel, recordings: Sequence[Recording], labels: Sequence[str]) -> tuple[Array, Array]:
    """Squares of the gap of torques and samples by joint and stretch of time, (n, W)."""
    pairs = zip(recordings, labels, strict=False)
    ready = [prepare(recording, sim.arm, label, k + 1) for k, (recording, label) in enumerate(pairs)]
    data, _ = residual_sets(ready, [])
    channel, count = data.layout.against_model, int(data.blocks.max()) + 1
    squares, weight = np.zeros((2, sim.n, count))
    for j in range(sim.n):
        there = data.valid[channel, j]
        squares[j] = np.bincount(data.blocks[there], data.values[channel, j][there] ** 2, count)
        weight[j] = np.bincount(data.blocks[there], minlength=count)
    return squares, weight


def _ranked(
    models: Sequence[str], squares: Array, counts: Array, free: Sequence[Array], unit: str, names: tuple[str, ...]
) -> ModelComparison:
    """The models, the best first, from squares (M, n, W) and samples (n, W); the same windows are drawn for all."""
    windows = counts.shape[1]
    drawn = np.random.default_rng(0).multinomial(windows, np.full(windows, 1.0 / windows), RESAMPLED).T
    share = 0.5 * (1.0 - INSIDE)

    def rms(weights: Array) -> Array:
        """By model, joint and draw (M, n, D), from draws of windows (W, D)."""
        return np.asarray(np.sqrt(squares @ weights / np.maximum(counts @ weights, 1e-300)))

    each, whole = rms(drawn.astype(float)), rms(np.ones((windows, 1)))[..., 0]
    total, overall = np.sqrt((each**2).mean(1)), np.sqrt((whole**2).mean(1))
    best = int(np.argmin(overall))
    ratio = total / np.maximum(total[best], 1e-300)
    made = []
    for m, model in enumerate(models):
        low, high = np.quantile(each[m], (share, 1.0 - share), axis=-1)
        (low_all, high_all), over = (np.quantile(x[m], (share, 1.0 - share)).tolist() for x in (total, ratio))
        whole_gap = float(overall[m]), low_all, high_all
        made.append(ModelGap(model, whole[m], low, high, whole_gap, free[m] if free else None, tuple(over)))
    return ModelComparison(unit, names, windows, tuple(sorted(made, key=lambda each: each.overall[0])))
