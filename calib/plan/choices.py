"""Every choice that a plan of sweeps rests on, with its reason; those of docs/theory.md are in its section 9."""

# what is assumed before the scout
GAIN_STD = 0.3
"""Standard deviation of an uncalibrated torque gain; tests/calib/drawn_arms.py draws 0.7 to 1.3."""
MODEL_ERROR = 0.1
"""Standard deviation of a model file's mass moments, as a share of each; a choice."""
SIGMAS = 3.0
"""Standard deviations of the rough model that its bounds include: 99.7 %."""

# reference mass
MASS_SHARES = (0.3, 0.5, 0.7)
"""Shares of the torque beyond gravity that the reference mass may take, tried from the smallest; a choice."""
ASSUMED_GRAVITY = 0.6
"""Share of max_torque that gravity is assumed to take before any measurement: drives have 1.5 to 2.2 times gravity in
tests/calib/drawn_arms.py."""
HAND = 0.15
"""Largest distance of the reference mass from the flange [m], as in tests/calib/drawn_arms.py."""

# poses of the scout
SCOUT_CANDIDATES = 300
"""Random poses among which the scout's are chosen; a choice: n + 3 of them are needed."""

# stops on which the resting joints are pressed
SKETCH_STEPS = 5
"""Steps by which a candidate sweep is judged: more than a sinusoid's three unknowns (docs/theory.md, section 5.3)."""
TRAVEL_COST = 0.6
"""Price of a second of travel between two sweeps, as log determinant (docs/theory.md, section 7.4)."""
PRIOR_GAIN, PRIOR_POSITION_GAIN, PRIOR_POINT = 0.15, 0.02, 0.2
"""Standard deviations before any reading of torque gain, position gain and place of the mass [m]
(docs/theory.md, section 7.4)."""

# sweeps
DEAD_LEVER = 0.005
"""Γ/g below which a joint is swept at one combination, for its offset alone (docs/theory.md, section 4.4)."""
SERVO_GAP = 0.05
"""Distance from the stop at which a servo-held joint rests [rad]; a choice."""
MORE_POSES = 2
"""Stop combinations per joint that may be added to reach the gains' precision; a choice: each takes minutes."""
FINEST = 3.0
"""Largest factor of precision by averaging longer: nine times the samples; a choice."""
ENOUGH = 1.2
"""Factor by which the gains may be less precise than asked without a note; a choice."""

# acceleration
SLOWEST = 0.3
"""Acceleration that every planned sweep must allow [rad/s²]: a step of 0.5 rad then takes 2.6 s; a choice."""
FASTEST = 2.0
"""Largest acceleration between sweeps [rad/s²]; a choice, swept in tests/campaigns/random_arms.py."""

# precision that is predicted
SIDE = 0.05
"""Lateral offset at which the reference mass is assumed to hang [m]; a choice."""
SCATTER = 1.3
"""Scatter of readings over the noise of their samples, since joints never rest completely: as the fits of
tests/campaigns/random_arms.py find it."""
HOPELESS = 0.15
"""Standard deviation beyond which more averaging cannot help a gain: that known beforehand (`PRIOR_GAIN`)."""

# collisions
POINTS = 15
"""Poses checked between two poses of a plan: 0.1 rad apart if a joint moves 1.5 rad; a choice."""
DEPTH = 0.0005
"""Overlap from which bodies count as touching [m]; a choice, below the accuracy of collision meshes."""
