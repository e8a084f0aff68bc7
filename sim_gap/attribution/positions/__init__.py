"""The answer from recordings without a torque channel, in radians."""
