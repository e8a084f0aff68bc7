"""A base that does not stand as the drawing says: turned about its own x axis, then about its y axis."""

from collections.abc import Mapping
from typing import Any

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _tilt(state: Imperfections, _joint: int, values: Mapping[str, Any]) -> None:
    state.tilt += values["angles"]


EFFECTS = (Effect("base.tilt", (Parameter("angles", "rad", (2,)),), _tilt, per_joint=False),)
