"""Errors of motor and drive: the torque made differs from the torque that the drive believes it makes (6077h)."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _gain(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.actuator_gain[joint] *= values["gain"]


def _rotor_inertia(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.rotor_inertia[joint] += values["inertia"]


def _lag(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.actuator_lag[joint] += values["time"]


def _delay(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.actuator_delay[joint] += values["time"]


def _saturation(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.actuator_saturation[joint] = np.minimum(state.actuator_saturation[joint], values["limit"])


EFFECTS = (
    Effect("actuator.gain", (Parameter("gain", "1", above=0.0),), _gain),
    Effect("actuator.rotor_inertia", (Parameter("inertia", "kg·m²", least=0.0),), _rotor_inertia),
    Effect("actuator.lag", (Parameter("time", "s", least=0.0),), _lag),
    Effect("actuator.delay", (Parameter("time", "s", least=0.0),), _delay),
    Effect("actuator.saturation", (Parameter("limit", "N·m", least=0.0),), _saturation),
)
