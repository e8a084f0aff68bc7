"""The motion that the nominal model makes along the commands by itself, and the solver that moved a recording.

Where MuJoCo makes of the nominal model what was measured there is no gap, whatever a simulation of each joint by itself
says. And that simulation can be tried on it: of rows that are 30 ms apart the others' motion between them does not
follow, which a joint feels.

In MuJoCo torques act from half a step before, damping is taken at a step's end or, in a servo and with Euler's method,
at its start, and joints creep under friction. All that is about numbers and not about the arm: recordings of another
simulation have it, those of a real arm have not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armlink.recording.recording import Recording, slice_rows
from gcomp.arrays import Array, Mask
from sim_gap.model.load import SimModel
from sim_gap.model.solver_friction import creep_speeds, creep_times
from sim_gap.position_gap.columns import with_columns
from sim_gap.position_gap.fit import LoopFit, Point, evaluate, improve
from sim_gap.position_gap.judge import rms_on
from sim_gap.position_gap.search import PRICE, LoopSearch, size_of
from sim_gap.position_gap.selection import prune
from sim_gap.position_gap.tracks import period_of, smoothing
from sim_gap.position_gap.training.replay import OPENING_S, Simulated, commanded_rows, judged_rows, replay
from sim_gap.position_gap.windows import thin, windows_of


def solvers(sim: SimModel, search: LoopSearch) -> list[dict[str, Array]]:
    """Effects of a solver that recordings may have, (J,) each: none, and those of MuJoCo's with the nominal model,
    without and with its friction, as far as it does anything.
    """
    import mujoco

    model, method, dofs = sim.mujoco_model, mujoco.mjtIntegrator, sim.mujoco_model.jnt_dofadr[list(sim.joints)]
    step = float(model.opt.timestep) * (model.opt.integrator != method.mjINT_RK4) * np.ones(sim.n)
    none, speeds = np.zeros(sim.n), creep_speeds(model, dofs)
    steps = {"early": 0.5 * step, "servo_late": step * (model.opt.integrator == method.mjINT_EULER)}
    rests = {"creep": none, "creep_lag": none}
    lag = np.maximum(creep_times(model, dofs) - 0.5 * (step + search.data.dt), 0.0)
    kinds = [{"early": none, "servo_late": none, **rests}]
    kinds += [{**steps, **rests}] if np.any(step) else []
    return kinds + ([{**steps, "creep": speeds, "creep_lag": lag}] if np.any(speeds) else [])


def nominal_solver(search: LoopSearch, kinds: Sequence[Point]) -> LoopSearch:
    """The search with the nominal model moved as the first of some solvers, or as another that leaves clearly less."""
    points = [{**search.nominal, **kind} for kind in kinds]
    none = ((),) * search.data.joints
    scores = [float(search.score(evaluate(search.data, LoopFit(point, none))).sum()) for point in points]
    return replace(search, nominal=points[_clearly_best(search, scores)])


def other_solver(search: LoopSearch, fit: LoopFit, kinds: Sequence[Point]) -> dict[str, Array] | None:
    """The other solver with which effects are worth choosing again; None without such.

    A delay, inertia and friction at every joint may stand for a solver: it is worth it where with the solver as many
    parameters as there are joints are not needed, or much less is left.
    """
    own, found = search.nominal, []
    for kind in kinds:
        if all(np.array_equal(kind[name], own[name]) for name in kind):
            continue
        there = replace(search, nominal={**own, **kind})
        moved = improve(there.data, replace(fit.with_values(**kind), rms=None), there.scales, 4)
        needed = prune(there, moved)
        fewer = size_of(fit) - size_of(needed) >= search.data.joints
        found.append((full_score(there, needed) - PRICE * search.data.joints * (1 if fewer else -1), kind))
    better = [each for each in found if each[0] < full_score(search, fit)]
    return dict(min(better, key=lambda each: each[0])[1]) if better else None


def full_score(search: LoopSearch, fit: LoopFit) -> float:
    return float(search.score(fit).sum()) + PRICE * size_of(fit)


def _clearly_best(search: LoopSearch, scores: Sequence[float]) -> int:
    """Number of the least of some scores, or 0 if it is not clearly less than the first."""
    best = int(np.argmin(scores))
    return best if scores[best] < scores[0] - PRICE * search.data.joints else 0


LEAST_ROWS = 20
"""Least number of rows that tell a gap and its noise."""
MODEL_NOISE_RAD = 1e-6
"""Noise of the model's own positions, which no sensor has read [rad]."""
ROUGHER = 1.5
"""Times the RMS of second differences of the measured positions up to which that of the model's own tells anything:
one that swings where the arm does not is no such motion."""


@dataclass(frozen=True, eq=False)
class OwnMotion:
    """Motion that MuJoCo makes of the nominal model along the commands of each recording."""

    sim: SimModel
    made: tuple[Recording, ...]
    """The recordings as the model would have made them, as far as all joints are commanded without a break."""
    scales: tuple[float, ...]
    """The controller's gains in each over those in the first."""
    gaps: Array
    """RMS of simulated minus measured positions of each recording and joint, (R, n) [rad]; infinite if it is short."""
    rougher: Array
    """RMS of second differences of simulated over those of measured positions, (R, n)."""
    noise: Array
    """RMS of the gap about its smooth course, (R, n) [rad]."""
    bends: Array
    """RMS of the simulated positions about theirs, (R, n) [rad]."""

    @property
    def alike(self) -> NDArray[np.intp]:
        """Numbers of the recordings that are long enough and in which the model moves no rougher than the arm."""
        return np.flatnonzero(np.isfinite(self.gaps).all(axis=1) & (self.rougher < ROUGHER).all(axis=1))

    def floor(self, search: LoopSearch, kinds: Sequence[Point]) -> Array:
        """RMS below which nothing can be seen, (n,) [rad], from that of the measured positions about their smooth
        course, in `search`, less what the model's own motion has of that: of rows 30 ms apart it is nearly all."""
        if not self.alike.size:
            return search.floor
        noise, bends = (np.sqrt(np.mean(x[self.alike] ** 2, axis=0)) for x in (self.noise, self.bends))
        rest = np.sqrt(np.maximum(search.floor**2 - bends**2, 0.0))
        noise = np.minimum(np.maximum(rest, noise), search.floor)
        return np.asarray(np.maximum(noise, self.missed(search, kinds)))

    def missed(self, search: LoopSearch, kinds: Sequence[Point]) -> Array:
        """RMS by which the simulation of each joint by itself misses this motion where it is `alike`, (n,) [rad]."""
        some, scales = [self.made[k] for k in self.alike], [self.scales[k] for k in self.alike]
        if not some:
            return np.zeros(self.sim.n)
        data = windows_of(self.sim.arm, some, ["the model's own motion"] * len(some), search.data.dt, scales)
        data = with_columns(thin(data, 8))
        exact = replace(search, data=data, floor=np.full(self.sim.n, MODEL_NOISE_RAD))
        as_it_moves = nominal_solver(exact, kinds).nominal
        return rms_on(data, LoopFit(as_it_moves, ((),) * data.joints))


def own_motion(
    sim: SimModel, recordings: Sequence[Recording], scales: Sequence[float], apart: Sequence[Mask]
) -> OwnMotion:
    """Move the nominal model, which has a controller at every joint, along the commands of each recording.

    `scales` are the gains of the controller in each over those in the first; rows set `apart` (K,) are not judged.
    """
    itself = Simulated(sim.mujoco_model, tuple(sim.joints))
    made, (gaps, rougher, noise, bends) = [], np.full((4, len(recordings), sim.n), np.inf)
    for k, (recording, scale, left_out) in enumerate(zip(recordings, scales, apart, strict=True)):
        t, positions, measured = replay(itself.with_gain(scale), recording)
        part = commanded_rows(recording)
        made.append(replace(slice_rows(recording, part), position=positions))
        period = period_of(recording)
        rows = judged_rows(t, left_out[part]) & np.isfinite(measured).all(axis=1)
        if rows.sum() * period >= OPENING_S and rows.sum() >= LEAST_ROWS:
            gap = (positions - measured)[rows]
            smooth, moved = smoothing(period, period), positions[rows]
            own, seen = (np.diff(q, 2, axis=0) for q in (moved, measured[rows]))
            each = (gap, gap - smooth(gap), moved - smooth(moved))
            gaps[k], noise[k], bends[k] = (np.sqrt(np.mean(x**2, axis=0)) for x in each)
            rougher[k] = np.sqrt(np.mean(own**2, axis=0) / np.maximum(np.mean(seen**2, axis=0), 1e-18))
    return OwnMotion(sim, tuple(made), tuple(scales), gaps, rougher, noise, bends)
