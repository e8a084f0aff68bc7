"""Errors of motor and drive: the motor torque differs from what the drive reports (6077h)."""

from sim_bus.effects.effect import NOT_NEGATIVE, POSITIVE, adds, effect, limits, scales

EFFECTS = (
    effect("actuator.gain", scales(lambda state: state.actuator_gain, "gain"), gain=POSITIVE),
    effect("actuator.rotor_inertia", adds(lambda state: state.rotor_inertia, "inertia"), inertia=NOT_NEGATIVE),
    effect("actuator.lag", adds(lambda state: state.actuator_lag, "time"), time=NOT_NEGATIVE),
    effect("actuator.delay", adds(lambda state: state.actuator_delay, "time"), time=NOT_NEGATIVE),
    effect("actuator.saturation", limits(lambda state: state.actuator_saturation, "limit"), limit=NOT_NEGATIVE),
)
