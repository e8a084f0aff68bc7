"""The plainest choice: nothing but the controller, Coulomb and viscous friction at every joint.

The score counts each half second as new, and recordings are few: effects that only resemble what a joint does are taken
together where one by one none can be spared, and gain and friction go with them. Motion that was not fitted is often
left no larger by the plainest choice.
"""

from collections.abc import Iterator
from dataclasses import replace

from sim_gap.closed_loop.fit import Fit, improve
from sim_gap.closed_loop.parameters import EFFECTS
from sim_gap.closed_loop.search import Search, effects_at, shared_of, start_of, taken_out

PLAINEST = "plainest"
PLAIN = "friction.coulomb", "friction.viscous"
ITERATIONS = 12


def plainest(search: Search, fit: Fit) -> Iterator[Fit]:
    """The fit with these alone at each joint that has anything else; nothing if none has."""
    kept = [
        effect for effect in EFFECTS if effect in search.kept or (effect in PLAIN and effect not in search.excluded)
    ]
    names = tuple(name for effect in kept for name in EFFECTS[effect].parameters)
    more = [j for j in range(search.data.joints) if not {*fit.active[j]} <= {*names}]
    other = fit
    for effect in shared_of(fit, search):
        other = taken_out(search, other, (effect, ()))
    for j in more:
        for effect in effects_at(fit, j):
            if effect not in kept:
                other = taken_out(search, other, (effect, (j,)))
    if not more and not fit.shared:
        return
    point = {name: values.copy() for name, values in other.point.items()}
    for j in more:
        for name in names:
            if point[name][j] == 0.0:
                point[name][j] = start_of(search, name, j)
    active = tuple(names if j in more else own for j, own in enumerate(other.active))
    yield improve(search.data, replace(other, point=point, active=active, rms=None), search.scales, ITERATIONS)
