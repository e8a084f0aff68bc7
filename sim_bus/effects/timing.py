"""Signals that come late."""

from collections.abc import Mapping
from typing import Any

from sim_bus.effects.registry import Effect, Parameter
from sim_bus.effects.state import Imperfections


def _delay(state: Imperfections, joint: int, values: Mapping[str, Any]) -> None:
    state.torque_delay[joint] += values["delay"]


EFFECTS = (Effect("timing.delay", (Parameter("delay", "s", least=0.0),), _delay),)
