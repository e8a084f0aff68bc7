"""Gravity model of a serial arm of revolute joints: pure functions of arrays."""
