"""Errors of the position sensor: `θ = gain·φ + offset + amplitude·sin(φ + phase)`, φ the reading, θ the true angle."""

from sim_bus.effects.effect import POSITIVE, ZERO_BY_DEFAULT, Values, adds, effect, scales
from sim_bus.effects.state import Imperfections


def _eccentricity(state: Imperfections, joint: int, values: Values) -> None:
    state.eccentricity[joint] = values["amplitude"], values["phase"]


EFFECTS = (
    effect("position.offset", adds(lambda state: state.position_offset, "offset")),
    effect("position.gain", scales(lambda state: state.position_gain, "gain"), gain=POSITIVE),
    effect("position.eccentricity", _eccentricity, phase=ZERO_BY_DEFAULT),
)
