"""Sweeps, sensor calibration, records and the gravity-torque observer."""
