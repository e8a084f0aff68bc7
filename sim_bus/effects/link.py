"""Masses that are not where the drawing says; all in the bar frame of their link."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _mass_moment(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.mass_moment[joint] += values["moment"]


def _inertia(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    added = np.zeros(6)
    added[: len(values["inertia"])] = values["inertia"]
    state.inertia[joint] += added


def _payload(state: Imperfections, _joint: int, values: Mapping[str, Any]) -> None:
    total = state.payload[0] + values["mass"]
    moment = state.payload[0] * state.payload[1:] + values["mass"] * values["com"]
    state.payload[:] = total, *(moment / total)


EFFECTS = (
    Effect("link.mass_moment", (Parameter("moment", "kg·m", (3,)),), _mass_moment),
    Effect("link.inertia", (Parameter("inertia", "kg·m²", (3, 6)),), _inertia),
    Effect(
        "link.payload", (Parameter("mass", "kg", above=0.0), Parameter("com", "m", (3,))), _payload, per_joint=False
    ),
)
