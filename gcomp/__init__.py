"""Gravity model of a serial revolute arm: pure math on arrays."""
