"""Masses that differ from the drawing; all in the bar frame of their link."""

import numpy as np

from sim_bus.effects.effect import POSITIVE, Domain, Values, adds, effect
from sim_bus.effects.state import Imperfections


def _inertia(state: Imperfections, joint: int, values: Values) -> None:
    """The list is xx, yy, zz or xx, yy, zz, xy, xz, yz."""
    added = np.zeros(6)
    added[: len(values["inertia"])] = values["inertia"]
    state.inertia[joint] += added


def _payload(state: Imperfections, _joint: int, values: Values) -> None:
    total = state.payload[0] + values["mass"]
    moment = state.payload[0] * state.payload[1:] + values["mass"] * values["com"]
    state.payload[:] = total, *(moment / total)


EFFECTS = (
    effect("link.mass_moment", adds(lambda state: state.mass_moment, "moment")),
    effect("link.inertia", _inertia, inertia=Domain(sizes=(3, 6))),
    effect("link.payload", _payload, mass=POSITIVE),
)
