"""Settings of the cause test, and a payload added to readings."""

from calib.observer.config import ObserverConfig
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_regressor

SIGMA = 0.05


CONFIG = ObserverConfig(position_std=0.0)


def payload(mass):
    def effect(arm, beta, q, direction, v, random):
        at_origin, by_point = payload_columns(arm)
        v += gravity_regressor(arm, q) @ (mass * (at_origin + by_point @ random.uniform(-0.15, 0.15, 3)))
        return "payload"

    return effect
