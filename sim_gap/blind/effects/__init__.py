"""The blind form of the effects: magnitudes that show in a recording, put into the true arm."""

from sim_gap.blind.effects import actuator, friction, link, position, torque, transmission
from sim_gap.blind.effects.drawn_effect import Draw

DRAWS: dict[str, Draw] = {
    **link.DRAWS,
    **position.DRAWS,
    **torque.DRAWS,
    **friction.DRAWS,
    **transmission.DRAWS,
    **actuator.DRAWS,
}
NOT_DRAWN = {"torque.nonlinearity": "no diagnosis names it, so a case of it could not be scored"}
"""Catalogue ids without a blind form, and why."""
EFFECTS = tuple(sorted(DRAWS))
