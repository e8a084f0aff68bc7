"""From where on a joint counts as blocked, slipped, at its stop or at rest."""

# on its way
STALL = 0.2
"""Following error at which a joint counts as blocked [rad]."""
LOST = 0.05
"""Following error at which a joint is no longer asked to go where it was asked to [rad]."""

# onto its stop
CREEP_AHEAD = 10
"""Rows that creeping is ahead of its samples: a job that is held up stops the creep after this many."""
CONTACT_LEAD = 0.015
"""A joint that its target leads by so much, and that does not move, stands at its stop [rad]."""
CONTACT_STILL = 0.15
"""Share of the approach speed below which a joint does not move."""
STOP_TOLERANCE = 0.06
"""How far from the arm file's place a stop may be found, beyond the position sensor's own error [rad]."""

# pressed on it
SLIP = 0.01
"""How far a pressed joint may leave its stop [rad]."""
BOUNCE = 0.05
"""How far it may while all are being pressed: one that lands throws the others [rad]."""
BOUNCE_SECONDS, BOUNCE_LOOK, BOUNCE_STILL = 2.0, 0.15, 0.003
"""Longest time that joints may take to stand on their stops [s]; how long one looks [s]; way in that time of one that
stands [rad]."""
PRESS_SECONDS = 0.3
"""Time over which the torque of a joint at its stop rises to its bias."""

# at rest
COAST, COAST_LOOK, COAST_STILL = 5.0, 0.1, 0.002
"""Longest time that joints may take to stop [s]; how often one looks [s]; way in that time of one that stands [rad]."""
CHECK_EVERY = 5
"""Cycles from one look at the settle rule to the next."""

# settled
DRIFT = 2.5
"""Standard errors by which the means of the window's halves may differ."""
WINDOW_TIMES = 3.0
"""Time constants of the slowest position loop in a window: what drifts more slowly is what one would call creep."""
QUIET = 1.0
"""Torque scatter that is this many times the standard error asked for has settled whatever its shape."""
