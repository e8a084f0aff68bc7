"""The blind form of the effects: magnitudes that show in a recording."""

from sim_gap.blind.effects import joint, link
from sim_gap.blind.effects.drawn_effect import Draw

DRAWS: dict[str, Draw] = {**link.DRAWS, **joint.DRAWS}
NOT_DRAWN = {
    "friction.bearing": "all friction of the simulated arm is between motor and torque sensor",
    "torque.nonlinearity": "no diagnosis names it, so a case of it could not be scored",
}
"""Catalogue ids without a blind form, and why."""
EFFECTS = tuple(sorted(DRAWS))
