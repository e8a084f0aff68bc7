"""Signals that are delayed."""

from sim_bus.effects.effect import NOT_NEGATIVE, adds, effect

EFFECTS = (effect("timing.delay", adds(lambda state: state.torque_delay, "delay"), delay=NOT_NEGATIVE),)
