"""The same motion at another scale: gains, friction, rotors and payloads smaller together.

Positions show ratios. The scale of all rests on what the model states: a little on its links, the rest on its rotors.
Where these are lighter than stated, a payload and a gain that is larger by as much leave nearly as little: between
both the score hardly changes, and a fit stays where it began.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sim_gap.closed_loop.columns import UNIT
from sim_gap.closed_loop.fit import Fit, improve
from sim_gap.closed_loop.parameters import WITH_TORQUE
from sim_gap.closed_loop.search import Search

SHARES = 0.7, 0.4
"""Scales at which a fit begins again, over its own."""
ITERATIONS = 12
ROTORS = "actuator.rotor_inertia"


def at_other_scales(search: Search, fit: Fit) -> Iterator[Fit]:
    """The fit from each smaller scale, the rotors that the model states free; none if there are none to free."""
    if ROTORS in search.excluded:
        return
    stated = search.nominal["armature"] > 0.0
    free = [("kp" in own and bool(stated[j]) and "armature" not in own) for j, own in enumerate(fit.active)]
    if not any(free):
        return
    active = tuple((*own, "armature") if loose else own for own, loose in zip(fit.active, free, strict=True))
    for share in SHARES:
        part = np.where(free, share, 1.0)
        point = {name: values * part if name in WITH_TORQUE else values.copy() for name, values in fit.point.items()}
        point |= {name: share * fit.point[name] for name in fit.shared if UNIT[name.partition(".")[2]] != "rad"}
        yield improve(search.data, replace(fit, point=point, active=active, rms=None), search.scales, ITERATIONS)
