"""The blind form of the effects that the simulated arm has: magnitudes that show in a recording."""

from sim_gap.blind.effects import arm

DRAWS = arm.DRAWS
EFFECTS = tuple(sorted(DRAWS))
