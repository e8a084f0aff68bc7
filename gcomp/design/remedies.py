"""Remedies for parameters that are not identifiable: the sweeps to add, or why no sweep helps."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array, Mask
from gcomp.design.choices import SKETCH_STEPS
from gcomp.design.sweep_design import Sweep, candidate_sweeps, readings_of
from gcomp.identify.block_qr import fold
from gcomp.identify.identifiability import analyse, describe_null_space
from gcomp.identify.natural_units import natural_units
from gcomp.identify.parameters import Parameters, free_mask, parameter_names
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import expected_readings, predict_and_jacobian
from gcomp.identify.thresholds import NULL_STD


def remedies(
    arm: Arm, readings: StaticReadings, guess: Parameters, *, unknown: Collection[str], load: float = 1.0
) -> Mapping[str, str]:
    """One sentence for each parameter that these readings do not determine: which sweeps would, or why none does.

    `readings` are those fitted and `guess` is the fit's `complete`. Sweeps of every joint at every stop combination
    are tried, without a load and then also with `load` [kg] of reference mass, several if one is not enough. An arm
    with a joint without limits has no stops: then nothing is tried.
    """
    trial = _Trial.of(arm, readings, guess, free_mask(arm.n, unknown))
    candidates = _candidates(trial, load)
    information = analyse(trial.triangle, trial.unit)
    lost = [name for name, found in zip(trial.names, information.determined, strict=True) if not found]
    answer: dict[str, str] = {}
    added: list[str] = []
    while len(answer) < len(lost):
        best = max(candidates, key=lambda each: each.gain(information.null_basis * trial.unit[:, None]), default=None)
        if best is None or best.gain(information.null_basis * trial.unit[:, None])[0] == 0:
            break
        added.append(best.words)
        trial = trial.with_rows(best.rows)
        information = analyse(trial.triangle, trial.unit)
        for name, found in zip(trial.names, information.determined, strict=True):
            if found and name in lost:
                answer.setdefault(name, "sweep " + ", then ".join(added))
    for name in lost:
        answer.setdefault(name, _why_not(name, describe_null_space(information.null_basis, trial.names)))
    return {name: answer[name] for name in lost}


def describe_sweep(arm: Arm, sweep: Sweep) -> str:
    """A sweep in words: joint_2 with joint_1 at its lower, joint_3 at its upper stop."""
    held = [
        f"{name} at its {'lower' if position == low else 'upper'}"
        for i, (name, position, low) in enumerate(zip(arm.names, sweep.pose, arm.lower, strict=True))
        if i != sweep.joint
    ]
    return arm.names[sweep.joint] + (f" with {', '.join(held)} stop" if held else "")


@dataclass(frozen=True, eq=False)
class _Trial:
    """The readings, with the sweeps added until now, as a triangular factor."""

    arm: Arm
    guess: Parameters
    free: Mask
    sigma: Array
    unit: Array
    names: tuple[str, ...]
    triangle: Array

    @classmethod
    def of(cls, arm: Arm, readings: StaticReadings, guess: Parameters, free: Mask) -> "_Trial":
        unit = natural_units(arm, expected_readings(arm, guess, readings), guess)[free]
        names = tuple(name for name, is_free in zip(parameter_names(arm), free, strict=True) if is_free)
        empty = cls(arm, guess, free, np.median(readings.sigma, axis=0), unit, names, np.zeros((len(unit),) * 2))
        for block in readings.blocks():
            empty = empty.with_rows(empty.weighted(block))
        return empty

    def weighted(self, readings: StaticReadings) -> Array:
        """Weighted Jacobian (P, p) of the readings that count."""
        _, jacobian, _ = predict_and_jacobian(self.arm, self.guess, readings)
        return jacobian[:, self.free] / readings.sigma[readings.counted][:, None]

    def with_rows(self, rows: Array) -> "_Trial":
        """With further rows (K, p)."""
        triangle = fold(self.triangle, rows)
        return _Trial(self.arm, self.guess, self.free, self.sigma, self.unit, self.names, triangle)


@dataclass(frozen=True, eq=False)
class _Candidate:
    words: str
    rows: Array
    loaded: bool

    def gain(self, null: Array) -> tuple[int, bool, float]:
        """(Number of the null directions (p, m) that these rows determine, whether without a load, how well)."""
        seen = np.linalg.svd(self.rows @ null, compute_uv=False)
        return int(np.sum(seen > 1 / NULL_STD)), not self.loaded, float(np.sum(np.log1p(seen)))


def _candidates(trial: _Trial, load: float) -> list[_Candidate]:
    """Every sweep at every stop combination, without and with the load."""
    arm = trial.arm
    if not (np.isfinite(arm.lower).all() and np.isfinite(arm.upper).all()):
        return []
    made = []
    for loads, words in (((0.0,), ""), ((0.0, load), " without and with a reference mass")):
        for sweep in (each for joint in range(arm.n) for each in candidate_sweeps(arm, joint, SKETCH_STEPS)):
            rows = trial.weighted(readings_of(arm, [sweep], trial.sigma, loads))
            made.append(_Candidate(describe_sweep(arm, sweep) + words, rows, len(loads) > 1))
    return made


def _why_not(name: str, null_space: Sequence[str]) -> str:
    sentence = next((each for each in null_space if name in each), "")
    if "changes no reading" in sentence:
        return "no sweep: gravity does not act on it in any pose; tilt the base"
    return f"no sweep: {sentence or 'nothing tells it from the others'}"
