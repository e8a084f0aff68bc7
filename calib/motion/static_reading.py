"""Averages over the samples of a static reading."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from armlink.link.types import Sample

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rest:
    """Averages over the samples of one static reading, (n,) each."""

    t: float
    count: int
    settled: bool
    position: Array
    position_std: Array
    torque: Array
    torque_std: Array
    motor_torque: Array


def stack(samples: list[Sample], channel: str) -> Array:
    """One channel of samples (K, n)."""
    return np.array([getattr(sample, channel) for sample in samples])


def average(samples: list[Sample], settled: bool) -> Rest:
    """Averages of samples; missing readings are left out."""
    position, torque, motor = (stack(samples, name) for name in ("position", "torque", "motor_torque"))
    reported = np.isfinite(motor).sum(axis=0)
    mean = np.nansum(motor, axis=0) / np.maximum(reported, 1)
    return Rest(
        t=samples[-1].t,
        count=int(np.isfinite(torque).all(axis=1).sum()),
        settled=settled,
        position=np.nanmean(position, axis=0),
        position_std=np.nanstd(position, axis=0),
        torque=np.nanmean(torque, axis=0),
        torque_std=np.nanstd(torque, axis=0, ddof=1),
        motor_torque=np.where(reported > 0, mean, np.nan),
    )
