"""A base that is tilted against the drawing: rotated about its own x axis, then about its y axis."""

from sim_bus.effects.effect import Values, effect
from sim_bus.effects.state import Imperfections


def _tilt(state: Imperfections, _joint: int, values: Values) -> None:
    state.tilt += values["angles"]


EFFECTS = (effect("base.tilt", _tilt),)
