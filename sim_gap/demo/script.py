"""How long everything in the demo takes, and how large it is."""

BY = "armlink demo"
"""Who keeps and writes its records."""

# motion for the recordings
TONES = 3
BAND = (0.08, 0.3)
"""Frequencies of the sines [Hz]."""
RANGE_SHARE = 0.35
"""Amplitude at most, as a share of half the joint's range."""
SPEED_SHARE = 0.6
"""Speed at most, as a share of the joint's max_velocity."""
ACCELERATION = 1.0
"""At most [rad/s²], for drives that have little torque left over gravity."""
FADE = 2.0
"""Time over which the motion begins [s]."""

RECORDED_S, CREEP_RECORDED_S = (40.0, 25.0), (30.0, 20.0)
"""Lengths of the gap's recordings, to learn from and to judge on [s]; of an arm without torque sensors."""

# comparison of gravity models
GRAVITY_POSES = 500
"""Random poses at which the identified model meets the plant's."""

# a torque sensor drifts
DRIFT_GAIN, DRIFT_OFFSET = 1.03, 0.3
"""Factor on its readings, and what is added to them [N·m]."""
DRIFT_OFFSET_SHARE = 0.05
"""The offset drift is no more than this share of rated torque."""
QUIET_SECONDS = 30.0
"""Ordinary work before the drift begins [s]."""
WORK_SECONDS = 300.0
"""Ordinary work at most [s]."""
SETTLED_SECONDS = 15.0
"""Ordinary work watched after a recalibration [s]."""

# joints sag under weak gains
SAG_POSES = 3
"""Poses that are held."""
SAG_SECONDS = 2.0
"""For which each pose is held [s]."""
WEAK_SHARE = 0.1
"""Of the arm file's gains."""
