"""The observer's state as JSON: what a restart goes on from."""

from collections.abc import Callable
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.decision import Agreeing
from calib.observer.observer import Observer
from calib.records.records import Array

SCHEMA = 1


def save_observer(observer: Observer) -> dict[str, Any]:
    """Everything that the observer has learnt, as JSON values; times are left out, since clocks restart."""
    told, known, places = observer.filter, observer.belief, observer.places
    first = observer.first
    return {
        "schema": SCHEMA,
        "sigma": observer.sigma.tolist(),
        "rows": observer.rows,
        "held": observer.held,
        "learnt": observer.learnt,
        "carrying": observer.carrying,
        "mass": known.mass,
        "doubtful": observer.doubtful,
        "beta": known.beta.tolist(),
        "factor": known.factor.tolist(),
        "state": told.state.tolist(),
        "covariance": told.covariance.tolist(),
        "accepted": told.accepted.tolist(),
        "rejected": told.rejected.tolist(),
        "recent": [row.tolist() for row in told.recent],
        "sums": observer.cusum.sums.tolist(),
        "places": [places.position.tolist(), places.mean.tolist(), places.count.tolist()],
        "window": [_row(row) for row in observer.window],
        "fresh": observer.fresh,
        "repeated": observer.repeated,
        "first": None if first is None else {"rows": [_row(row) for row in first.rows], "joints": sorted(first.joints)},
        "said": None if observer.said is None else [observer.said[0], list(observer.said[1])],
        "reasons": list(observer.reasons),
        "direction": observer.rest.direction.tolist(),
        "left": [None if np.isnan(q) else float(q) for q in observer.rest.left],
    }


def restore_observer(observer: Observer, state: dict[str, Any]) -> bool:
    """Put a saved state into a new observer of the same arm and records; False, and nothing done, where it is none."""
    n = observer.arm.n
    try:
        if state["schema"] != SCHEMA or np.shape(state["covariance"]) != (n, 2, 2):
            return False
        numbers = {name: np.array(state[name], dtype=float) for name in _SHAPES}
        shapes = {name: shape(n) for name, shape in _SHAPES.items()}
        if any(numbers[name].shape != shape or not np.isfinite(numbers[name]).all() for name, shape in shapes.items()):
            return False
        window = [_unrow(row) for row in state["window"]]
        first = state["first"]
        agreeing = None if first is None else ([_unrow(row) for row in first["rows"]], frozenset(first["joints"]))
        factor = np.array(state["factor"], dtype=float).reshape(2 * n, -1)
        position, mean, count = state["places"]
        kept = (np.array(position).reshape(-1, n), np.array(mean).reshape(-1, n), np.array(count, dtype=int))
        recent = [np.array(row, dtype=float) for row in state["recent"]]
        left = np.array([np.nan if q is None else q for q in state["left"]])
        whole = {name: int(state[name]) for name in ("rows", "learnt", "fresh", "repeated", "carrying")}
        mass = float(state["mass"])
        said = None if state["said"] is None else (str(state["said"][0]), tuple(state["said"][1]))
        reasons = tuple(state["reasons"])
    except (KeyError, TypeError, ValueError):
        return False
    observer.sigma, observer.belief.beta, observer.belief.factor = numbers["sigma"], numbers["beta"], factor
    observer.filter.state, observer.filter.covariance = numbers["state"], numbers["covariance"]
    observer.filter.accepted = numbers["accepted"].astype(int)
    observer.filter.rejected = numbers["rejected"].astype(int)
    observer.filter.recent.extend(recent)
    observer.cusum.sums = numbers["sums"]
    observer.places.position, observer.places.mean, observer.places.count = kept
    observer.rest.direction, observer.rest.left = numbers["direction"], left
    observer.rows, observer.learnt = whole["rows"], whole["learnt"]
    observer.window, observer.fresh, observer.repeated = window, whole["fresh"], whole["repeated"]
    observer.carrying, observer.belief.mass = whole["carrying"], mass
    observer.held, observer.doubtful = bool(state["held"]), bool(state["doubtful"])
    observer.said, observer.reasons = said, reasons
    if agreeing is not None:
        observer.first = Agreeing(agreeing[0], observer.cause_test(agreeing[0]), agreeing[1])
    return True


_SHAPES: dict[str, Callable[[int], tuple[int, ...]]] = {
    "sigma": lambda n: (n,),
    "beta": lambda n: (2 * n,),
    "state": lambda n: (n, 2),
    "covariance": lambda n: (n, 2, 2),
    "accepted": lambda n: (n,),
    "rejected": lambda n: (n,),
    "sums": lambda n: (n, 4),
    "direction": lambda n: (n,),
}


def _row(row: StaticReading) -> list[Any]:
    return [row.t, row.position.tolist(), row.torque.tolist(), row.direction.tolist()]


def _unrow(row: list[Any]) -> StaticReading:
    position, torque, direction = (_vector(values) for values in row[1:4])
    return StaticReading.of(float(row[0]), position, torque, direction)


def _vector(values: Any) -> Array:
    return np.array(values, dtype=float)
