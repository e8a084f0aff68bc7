"""Whether recordings move as MuJoCo's solver moves the nominal model, or as an arm that its parameters describe.

In MuJoCo torques act from half a step before, damping is taken at a step's end or, in a servo and with Euler's method,
at its start, and joints creep under friction. All that is about numbers and not about the arm: recordings of another
simulation have it, those of a real arm have not.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.choice.prune import pruned
from sim_gap.closed_loop.fit import Fit, Point, evaluate, improve
from sim_gap.closed_loop.search import PRICE, Search, size_of
from sim_gap.model.load import SimModel
from sim_gap.model.solver_friction import creep_speeds, creep_times


def solvers(sim: SimModel, search: Search) -> list[dict[str, Array]]:
    """What recordings may have of a solver, (J,) each: nothing, and what MuJoCo's does with the nominal model, without
    and with its friction, as far as it does anything.
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


def nominal_solver(search: Search, kinds: Sequence[Point]) -> Search:
    """The search with the nominal model moved as the first of some solvers, or as another that leaves clearly less."""
    points = [{**search.nominal, **kind} for kind in kinds]
    none = ((),) * search.data.joints
    scores = [float(search.score(evaluate(search.data, Fit(point, none))).sum()) for point in points]
    return replace(search, nominal=points[_clearly_best(search, scores)])


def other_solver(search: Search, fit: Fit, kinds: Sequence[Point]) -> dict[str, Array] | None:
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
        needed = pruned(there, moved)
        fewer = size_of(fit) - size_of(needed) >= search.data.joints
        found.append((priced(there, needed) - PRICE * search.data.joints * (1 if fewer else -1), kind))
    better = [each for each in found if each[0] < priced(search, fit)]
    return dict(min(better, key=lambda each: each[0])[1]) if better else None


def priced(search: Search, fit: Fit) -> float:
    """Score of a fit with what its parameters cost."""
    return float(search.score(fit).sum()) + PRICE * size_of(fit)


def _clearly_best(search: Search, scores: Sequence[float]) -> int:
    """Number of the least of some scores, or 0 if it is not clearly less than the first."""
    best = int(np.argmin(scores))
    return best if scores[best] < scores[0] - PRICE * search.data.joints else 0
