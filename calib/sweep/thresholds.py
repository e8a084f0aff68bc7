"""Every threshold of preflight, sweep and verification."""

# preflight
LISTEN = 0.5
"""Seconds for which the sensors are listened to at rest, after as long again in which switching on dies down."""
MISSING, LATE = 0.1, 0.5
"""Shares of readings from which on they are said to be missing, and to be late."""
LOUD = 0.05
"""Noise of a torque sensor, as a share of rated torque, from which it is not fit for a calibration."""
NEAR_LIMIT = 1.9
"""Reading, in rated torques, at which a torque sensor is about to saturate."""
STOP_APPROACH = 0.08
"""Distance from the arm file's stop from which a joint creeps [rad]."""
HOT = 70.0
"""Temperature of a drive from which no sweep is begun: it would fall or rise while the sensors are read [°C]."""

# scout
SCOUT_ACCELERATION = 1.0
"""Nothing is known of the arm's weight yet [rad/s²]."""
SLOWER, SLOWEST = 0.4, 0.15
"""Factor on the acceleration after a joint did not follow, and where that ends [rad/s²]."""

# sweep
APPROACH = 0.03
"""Each step is approached over at least this way [rad]."""
GAP = 0.02
"""Distance from a stop at which creeping begins [rad]."""
RETRIES = 3
"""How often a joint that slipped or stalled is tried again before the sweep gives up."""

# verification
ACCELERATION = 2.0
"""Of travel between poses [rad/s²]; a choice."""
TOLERANCE = 0.01
"""RMS that passes, as a share of the joint's largest model torque: twice the error of gravity torque that
tests/calib/drawn_arms.py allows."""
EXPECTED = 2.5
"""RMS that passes, as a multiple of what the records expect: a field that is alike over much of the range is drawn anew
only a few times by the poses, and a mean of two squares exceeds this one time in five hundred."""
NOISE_FLOOR = 0.003
"""RMS that always passes, as a share of rated torque: the error of an offset that tests/calib/drawn_arms.py allows."""
