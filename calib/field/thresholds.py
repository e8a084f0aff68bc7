"""Every threshold and prior of the calibration in the field (docs/theory.md, section 4.3)."""

# rows of a recording
WINDOW = 0.25
"""Length of a window, which is averaged to one row [s]."""
FEWEST_SAMPLES = 3
"""Samples of a window; its slope and scatter need as many."""
SLOW = 0.1
"""Largest speed of any joint in a window that counts: centrifugal torque is then below 0.1 N·m at 10 kg·m² [rad/s]."""
STEADY = 0.05
"""Largest change of any joint's speed [rad/s²] (docs/theory.md, section 6.1)."""
MOVED = 0.004
"""Motion of a joint after which its direction counts as changed [rad]."""
FEWEST_ROWS = 12
"""Rows that a recording must have: three unknowns a joint, and some more for the scatter."""

# priors
HYSTERESIS = 0.01
"""Prior standard deviation of f_i, as a share of rated torque (docs/theory.md, section 4.3)."""
UNKNOWN_MOMENT = 10.0
"""Prior standard deviation of a mass moment that is not identifiable in the gravity record [kg·m]."""

# fit
GAIN_STD = 0.02
"""Relative standard deviation above which a gain counts as not separable from the offset."""
OFFSET_STD = 0.005
"""Likewise of an offset, as a share of rated torque."""
DRIFT = 0.05
"""Standard deviation allowed for the drift of a gain that these rows do not show, as a ratio."""
ROUNDS = 4
"""Gauss-Newton steps, each with the noise scaled to the residuals' scatter."""
PAYLOAD_EVIDENCE = 10.0
"""BIC difference up to which a payload that explains the rows worse than new gains and offsets is not excluded."""

# judging on held-out rows
BLOCK = 24
"""Rows that are held out together, since neighbours are correlated: six seconds of a recording."""
