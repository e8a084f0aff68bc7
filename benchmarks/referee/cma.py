"""CMA-ES (PyPI `cmaes`) within the unit box until it is at rest or its processor time is over: two adapters use it."""

import time
from collections.abc import Callable
from typing import Any

import cmaes
import numpy as np


def lowest(cost: Callable[[Any], float], first: Any, sigma: float, cpu_seconds: float) -> Any:
    """The best point that the search met, the first one included."""
    search = cmaes.CMA(mean=first, sigma=sigma, bounds=np.tile([0.0, 1.0], (len(first), 1)), seed=1)
    best, at = cost(first), first
    while time.process_time() < cpu_seconds and not search.should_stop():
        told = [(x, cost(x)) for x in (search.ask() for _ in range(search.population_size))]
        search.tell(told)
        for x, value in told:
            if value < best:
                best, at = value, x
    return at
