"""Errors of the joint torque sensor.

In this order: crosstalk mixes the joints' torques; hysteresis (a play of half width `width`), dead band and saturation
bend the signal; then `v = gain·τ + offset + rate·t` on top of the sensor's own gain and offset.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _offset(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.torque_offset[joint] += values["offset"]


def _gain(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.torque_gain[joint] *= values["gain"]


def _drift(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.torque_drift[joint] += values["rate"]


def _crosstalk(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.crosstalk[joint, values["source"]] += values["coefficient"]


def _hysteresis(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.hysteresis[joint] += values["width"]


def _deadband(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.deadband[joint] += values["width"]


def _saturation(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.torque_saturation[joint] = np.minimum(state.torque_saturation[joint], values["limit"])


EFFECTS = (
    Effect("torque.offset", (Parameter("offset", "N·m"),), _offset),
    Effect("torque.gain", (Parameter("gain", "1"),), _gain),
    Effect("torque.drift", (Parameter("rate", "N·m/s"),), _drift),
    Effect(
        "torque.crosstalk",
        (Parameter("coefficient", "N·m/(N·m)"), Parameter("source", "joint", joint=True)),
        _crosstalk,
    ),
    Effect("torque.hysteresis", (Parameter("width", "N·m", least=0.0),), _hysteresis),
    Effect("torque.deadband", (Parameter("width", "N·m", least=0.0),), _deadband),
    Effect("torque.saturation", (Parameter("limit", "N·m", least=0.0),), _saturation),
)
