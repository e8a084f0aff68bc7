"""Errors of the position sensor: `θ = gain·φ + offset + amplitude·sin(φ + phase)`, φ the reading, θ the true angle."""

from collections.abc import Mapping
from typing import Any

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _offset(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.position_offset[joint] += values["offset"]


def _gain(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.position_gain[joint] *= values["gain"]


def _eccentricity(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.eccentricity[joint] = values["amplitude"], values["phase"]


EFFECTS = (
    Effect("position.offset", (Parameter("offset", "rad"),), _offset),
    Effect("position.gain", (Parameter("gain", "1", above=0.0),), _gain),
    Effect(
        "position.eccentricity", (Parameter("amplitude", "rad"), Parameter("phase", "rad", default=0.0)), _eccentricity
    ),
)
