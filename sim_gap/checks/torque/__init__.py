"""Checks of a torque channel: what it measures, its unit, and its clock."""
