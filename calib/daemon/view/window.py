"""Readings of the last minutes as the view gives them to the web layer."""

from dataclasses import dataclass
from datetime import datetime

from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class Window:
    """K rows of n joints, oldest first."""

    names: tuple[str, ...]
    time: datetime
    """Of the newest row."""
    t: Array
    """Time since the oldest row (K,) [s]."""
    channels: dict[str, Array]
    """`position` [rad], `torque` and `model_torque` [N·m], `temperature` [°C] → (K, n); NaN if missing."""
