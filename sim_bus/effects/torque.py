"""Errors of the joint torque sensor.

In this order: crosstalk mixes the joints' torques; hysteresis (a play of half width `width`), dead band and saturation
distort the signal; then `v = gain·τ + offset + rate·t` on top of the sensor's own gain and offset.
"""

from sim_bus.effects.effect import NOT_NEGATIVE, Values, adds, effect, limits, scales
from sim_bus.effects.state import Imperfections


def _crosstalk(state: Imperfections, joint: int, values: Values) -> None:
    state.crosstalk[joint, values["source"]] += values["coefficient"]


EFFECTS = (
    effect("torque.offset", adds(lambda state: state.torque_offset, "offset")),
    effect("torque.gain", scales(lambda state: state.torque_gain, "gain")),
    effect("torque.drift", adds(lambda state: state.torque_drift, "rate")),
    effect("torque.crosstalk", _crosstalk),
    effect("torque.hysteresis", adds(lambda state: state.hysteresis, "width"), width=NOT_NEGATIVE),
    effect("torque.deadband", adds(lambda state: state.deadband, "width"), width=NOT_NEGATIVE),
    effect("torque.saturation", limits(lambda state: state.torque_saturation, "limit"), limit=NOT_NEGATIVE),
)
