"""Where a fit begins: the natural sizes of the joints, and the best of some gains and frictions at each."""

from dataclasses import replace
from itertools import product

import numpy as np
from scipy.stats import qmc

from gcomp.arrays import Array, Mask
from gcomp.estimate.linear_terms import PRICE
from gcomp.estimate.problem import NORMAL
from sim_gap.position_gap.choice import FEW, Progress, costs_of, worth
from sim_gap.position_gap.fit import LoopFit, LoopSearch, residuals
from sim_gap.position_gap.parameters import Scales
from sim_gap.position_gap.plant import nominal_point
from sim_gap.position_gap.windows import Windows, thin

GAINS = 0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0, 1.7, 3.0
"""Gains that are tried, over that of the model."""
FREQUENCIES_HZ = 0.7, 1.0, 1.5, 2.2, 3.3, 5.0, 7.5, 11.0, 16.0
"""Natural frequencies of the gains that are tried where the model has none [Hz]."""
FRICTIONS = 0.0, 0.4
"""Least Coulomb friction that is tried with each gain, as a share of the gain times the RMS error."""
LEAST_DAMPING = 0.2
"""Least damping that is tried with each gain, over the root of gain times inertia (2 is critical)."""
SERVOS = 64
"""Servos with limits of torque and of speed and with a lag that are drawn: a power of two, as Sobol's sequence asks."""
SERVO_RANGES = {
    "kp": (0.003, 30.0),
    "viscous": (0.2, 10.0),
    "coulomb": (0.02, 2.0),
    "limit": (0.5, 50.0),
    "lag": (0.003, 1.0),
    "slew": (0.05, 5.0),
}
"""Their ranges, each drawn in its logarithm: over the model's gain, the root of gain times inertia, the joint's torque
(friction and limit), 1 s, and the highest speed of the joint."""
BEST_SERVOS = 3
"""Drawn servos of each joint from which a fit begins, the best first."""
TURNS = 0.02
"""Speed over which friction changes its direction there [rad/s]."""
RESTS_RAD = 0.002
"""Way of a command over all recordings below which it rests [rad]."""
HOLDS_HZ = 10.0
"""Natural frequency of the controller that is assumed for a joint that rests and has none [Hz]."""
LEAST_FLOOR = 1e-5
"""Least noise floor of a position gap [rad]."""


def scales_of(data: Windows) -> Scales:
    """Natural sizes of each joint along the recordings."""
    arm, weight, nominal = data.plant.sim.arm, data.weight, nominal_point(data.plant)
    count = np.maximum(weight.sum((0, 2)), 1.0)

    def rms(values: Array) -> Array:
        return np.asarray(np.sqrt((values**2 * weight).sum((0, 2)) / count))

    middle = data.measured[:: max(1, len(data.measured) // 8)].transpose(0, 2, 1).reshape(-1, arm.n)
    inertia = np.empty(arm.n)
    for j in range(arm.n):
        unit = np.zeros_like(middle)
        unit[:, j] = 1.0
        inertia[j] = arm.torque(middle, 0.0 * middle, unit, np.zeros(3))[:, j].mean()
    inertia = np.maximum(inertia, 1e-7) + arm.armature
    torque = np.maximum(rms(data.torque), 1e-6)
    served = np.maximum((data.served * weight).sum((0, 2)), 1.0)
    error = np.sqrt((data.served * weight * data.error**2).sum((0, 2)) / served)
    # what the model has is in doubt by its own size, however little the links ask for
    friction = np.maximum(torque, nominal["coulomb"])
    damping = np.maximum(torque / np.maximum(rms(data.v), 0.05), nominal["viscous"])
    return Scales(torque, friction, damping, inertia, np.maximum(error, 1e-4))


def noise_floor(data: Windows) -> Array:
    """Standard deviation of the position readings about their smooth course, per joint (J,) [rad]."""
    return np.asarray(np.maximum(np.sqrt(np.mean(data.noise**2, axis=1)), LEAST_FLOOR))


def starting_fit(search: LoopSearch, progress: Progress) -> tuple[LoopSearch, LoopFit]:
    """The search with what rests left out, and a fit of gain, Coulomb and viscous friction at every other joint."""
    progress("fitting gains and friction as a start")
    at_rest, complete = rests(search.data), bool(search.data.plant.driven.all())
    search = replace(search, resting=frozenset(np.flatnonzero(at_rest).tolist()))
    if not complete:
        search = replace(search, nominal=_holding(search), open_controller=True)
        search = replace(search, excluded=search.excluded | {"actuator.gain"})
    few = replace(search, data=thin(search.data, FEW, moving=True))
    points = _points(few)
    gaps = residuals(few.data, points)
    costs = np.einsum("ptjw,tjw->pj", np.minimum(np.abs(gaps), 1.0) ** 2, few.data.weight)
    best = costs.argmin(0)
    point = {name: np.array([points[b][name][j] for j, b in enumerate(best)]) for name in points[0]}
    # a joint that swings with its servo off shows friction and inertia against gravity, and only both together
    swings = np.any((search.data.served < 0.5) & (search.data.weight > 0.0), axis=(0, 2))
    moving = np.flatnonzero(~at_rest).tolist()
    free = [(j, name) for j in moving for name in ("kp", "viscous", "coulomb", *(("armature",) if swings[j] else ()))]
    kept = "friction.coulomb", "friction.viscous", "controller.stiffness"
    search = replace(search, kept=frozenset(kept[: 2 if complete else 3]))
    few = replace(few, nominal=search.nominal)
    # all rows count at first: far from the arm's motion a robust fit would take the motion for outliers
    fit = few.improve(LoopFit(point, tuple(free)), 5, NORMAL)
    if np.any(search.nominal["creep"] > 0.0):
        rest = {"creep": np.zeros(search.data.joints)}
        at_rest_fit = few.improve(fit.with_values(**rest), 4, NORMAL)
        # gears hold what rests: a model's solver that lets it creep is no statement about the arm
        if float((few.score(at_rest_fit.point) - few.score(fit.point)).sum()) < PRICE:
            search, fit = replace(search, nominal={**search.nominal, **rest}), at_rest_fit
    return search, fit


def limited_servo_start(search: LoopSearch, fit: LoopFit, where: Mask) -> LoopFit:
    """The best of fits that begin at drawn servos with limits at the joints `where` (J,), and at `fit` elsewhere.

    A saturated servo hides its gain and its lag, so that no step from one without limits leads there.
    """
    few = replace(search, data=thin(search.data, FEW, moving=True))
    drawn = _drawn_servos(few, fit, where)
    names = [name for name in SERVO_RANGES if name != "lag" or search.nominal["lag"].any()]
    free = [*fit.free, *((j, name) for j in np.flatnonzero(where).tolist() for name in names)]
    starts = []
    for best in costs_of(few, drawn).argsort(axis=0)[:BEST_SERVOS]:
        point = {name: np.array([drawn[b][name][j] for j, b in enumerate(best)]) for name in fit.point}
        starts.append(few.improve(LoopFit(point).freed(free), 2))
    return few.improve(max(starts, key=lambda each: worth(few, each)), 5)


def _drawn_servos(search: LoopSearch, fit: LoopFit, where: Mask) -> list[dict[str, Array]]:
    """Points with servos drawn over `SERVO_RANGES` at the joints `where` (J,), by Sobol's sequence and so the same each
    time."""
    low, high = np.log(np.array([*SERVO_RANGES.values()])).T
    nominal, scales = search.nominal, search.scales
    points = []
    for row in np.exp(qmc.scale(qmc.Sobol(len(low), scramble=False).random(SERVOS), low, high)):
        share = dict(zip(SERVO_RANGES, row.tolist(), strict=True))
        kp = nominal["kp"] * share["kp"]
        servo = {
            "kp": kp,
            "viscous": share["viscous"] * np.sqrt(kp * scales.inertia),
            "coulomb": share["coulomb"] * scales.torque,
            "limit": share["limit"] * scales.torque,
            "lag": np.where(nominal["lag"] > 0.0, share["lag"], 0.0),
            "slew": share["slew"] * search.size_of("slew"),
        }
        points.append({name: np.where(where, servo.get(name, values), values) for name, values in fit.point.items()})
    return points


def _points(search: LoopSearch) -> list[dict[str, Array]]:
    """Points that are tried: the nominal model, and gains with least frictions."""
    nominal, driven = search.nominal, search.data.plant.driven
    centre = np.where(driven, nominal["kp"], search.scales.inertia)
    tries = np.where(
        driven,
        np.array(GAINS)[:, None],
        (2.0 * np.pi * np.array(FREQUENCIES_HZ)[:, None]) ** 2,
    )
    points = [nominal] if driven.all() else []
    for factor, stuck in product(tries, FRICTIONS):
        kp = np.maximum(centre * factor, 1e-3)
        point = {name: values.copy() for name, values in nominal.items()}
        point["kp"] = kp
        for j in range(search.data.joints):
            point["coulomb"][j], point["viscous"][j] = _friction(search, j, float(kp[j]), stuck)
        points.append(point)
    for j in search.resting:
        for point in points:
            for name in point:
                point[name][j] = search.nominal[name][j]
    return points


def _friction(search: LoopSearch, j: int, kp: float, stuck: float) -> tuple[float, float]:
    """Coulomb friction and damping that a gain asks for along the recorded motion, by least squares."""
    data, counted = search.data, (search.data.weight[:, j] * search.data.served[:, j]) > 0.0
    v, over = data.v[:, j][counted], (kp * data.error[:, j] - data.torque[:, j])[counted]
    columns = np.column_stack([np.tanh(v / TURNS), v])
    coulomb = max(float(np.linalg.lstsq(columns, over, rcond=None)[0][0]), stuck * kp * float(search.scales.angle[j]))
    rest = over - coulomb * columns[:, 0]
    viscous = float(v @ rest) / max(float(v @ v), 1e-12)
    return coulomb, max(viscous, LEAST_DAMPING * np.sqrt(kp * float(search.scales.inertia[j])))


def rests(data: Windows) -> Mask:
    """Joints whose command rests in all windows, (J,): any controller holds them there; not those that move while the
    servo is off."""
    on, told = data.served > 0.5, data.weight > 0.0

    def way(values: Array, where: Mask) -> Array:
        high, low = np.where(where, values, -np.inf).max((0, 2)), np.where(where, values, np.inf).min((0, 2))
        return np.asarray(high - low)

    commanded, free = way(data.measured + data.error, on & told), way(data.measured, ~on & told)
    return np.asarray((on & told).any(axis=(0, 2)) & (commanded < RESTS_RAD) & ~(free >= RESTS_RAD))


def _holding(search: LoopSearch) -> dict[str, Array]:
    """The nominal values, with a controller at joints (J,) that have none: critically damped, and stiff."""
    held, missing = dict(search.nominal), ~search.data.plant.driven
    frequency = 2.0 * np.pi * HOLDS_HZ
    held["kp"] = np.where(missing, search.scales.inertia * frequency**2, held["kp"])
    held["viscous"] = np.where(missing, 2.0 * search.scales.inertia * frequency, held["viscous"])
    held["kv"] = np.where(missing, np.inf, held["kv"])
    return held


def controller_name(fit: LoopFit) -> str:
    """The controller that was found: P, PD, PI, PID, with feed-forward or without."""
    names = {name for _, name in fit.free}
    kind = "P" + "I" * ("ki" in names) + "D" * ("kd" in names)
    return kind + " with feed-forward" * ("feed" in names)
