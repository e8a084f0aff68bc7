"""External torque of samples as they come from a bus."""

from dataclasses import dataclass

import numpy as np

from armlink.errors import BadInput
from calib.external.even_samples import LONGEST_GAP
from calib.external.learned import Learned
from gcomp.arrays import Array
from gcomp.external.contact import ContactDetector, ContactEvent
from gcomp.external.filtered_rows import RowFilter, Samples
from gcomp.external.rigid_motion import RigidMotion
from gcomp.external.wrench import Wrench, wrench


@dataclass(frozen=True, eq=False)
class ExternalRow:
    """The newest row."""

    t: float
    """[s]"""
    external: Array
    """(n,) [N·m], with which the surroundings push."""
    std: Array
    """(n,) [N·m]."""
    motion: RigidMotion


class LiveExternal:
    """`take` samples at the bus's rate; `row` is the newest row, None while there is none."""

    def __init__(self, learned: Learned, rate: float) -> None:
        """`rate` [Hz] is the bus's; raises BadInput if it is no multiple of that of the samples learned from."""
        listener = learned.listener
        self._group = max(1, round(rate / listener.rate))
        if abs(rate / (self._group * listener.rate) - 1.0) > 0.02:
            raise BadInput(f"learned from {listener.rate:g} samples a second, which do not fit {rate:g} on the bus")
        self.learned = learned
        self.restart()

    def restart(self) -> None:
        """The next samples do not follow from those before."""
        model = self.learned.listener.model
        self._filter: RowFilter = model.filter(self.learned.listener.rate)
        self._detector = ContactDetector(model, self.learned.per_hour, self.learned.frame.point)
        self._left = np.empty((0, 1 + 3 * model.arm.n))
        self._last: Array | None = None
        self.row: ExternalRow | None = None

    @property
    def load(self) -> float:
        """Mass that the arm has taken up since the samples began [kg]."""
        return float(self._detector.load[0])

    def take(
        self, t: Array, position: Array, velocity: Array, torque: Array, temperature: Array | None
    ) -> list[ContactEvent]:
        """Samples at times (K,) [s], (K, n) each, and temperatures (n,) [°C]; samples with a NaN are left out."""
        listener = self.learned.listener
        n, rate = listener.model.arm.n, listener.rate
        taken = np.column_stack([t, position, velocity, torque])
        taken = taken[np.isfinite(position).all(1) & np.isfinite(torque).all(1)]
        if not len(taken):
            return []
        before = self._left[-1] if len(self._left) else self._last
        if before is not None and np.diff(taken[:, 0], prepend=before[0]).max() > LONGEST_GAP:
            self.restart()
        taken = np.concatenate([self._left, taken])
        whole = len(taken) // self._group * self._group
        self._left = taken[whole:]
        if not whole:
            return []
        means = taken[:whole].reshape(-1, self._group, taken.shape[1]).mean(axis=1)
        q, v, torque = means[:, 1 : 1 + n], means[:, 1 + n : 1 + 2 * n], means[:, 1 + 2 * n :]
        if not np.isfinite(v).all():
            first = q[:1] if self._last is None else self._last[None, 1 : 1 + n]
            v = np.diff(q, axis=0, prepend=first) * rate
        self._last = means[-1]
        calibration = listener.records.calibration
        if calibration is not None:
            q, v = calibration.angle(q), v * calibration.values("position_gain", 1.0)
        warmth = np.zeros_like(q)
        if temperature is not None and listener.warm is not None:
            warmth += np.nan_to_num(temperature - listener.warm)
        filtered = self._filter.rows(Samples(q, v, torque, warmth))
        if not len(filtered.by_link):
            return []
        when = means[filtered.chosen, 0]
        judged, events = self._detector.judge(when, listener.model.rows(filtered))
        self.row = ExternalRow(
            float(when[-1]), judged.external[-1], judged.std[-1], filtered.motion.part(slice(-1, None))
        )
        return events

    def wrench(self) -> Wrench | None:
        """Of the newest row at the frame learned for."""
        row, frame = self.row, self.learned.frame
        if row is None:
            return None
        precision = self.learned.listener.model.lasting.precision
        return wrench(row.motion, frame.link, frame.point, row.external[None], row.std[None], precision)
