"""External torque of samples as they come from a bus."""

from dataclasses import dataclass

import numpy as np

from calib.external.even_samples import LONGEST_GAP, averaged_samples
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


MEASURED_SAMPLES = 10
"""From which the time between two of them is taken."""


class LiveExternal:
    """`take` samples as they come; `row` is the newest row, None while there is none.

    Samples of any rate are taken at even times, as those of recordings are.
    """

    def __init__(self, learned: Learned) -> None:
        self.learned = learned
        self.restart()

    def restart(self) -> None:
        """The next samples do not follow from those before."""
        model = self.learned.listener.model
        self._filter: RowFilter = model.filter(self.learned.listener.rate)
        self._detector = ContactDetector(model, self.learned.per_hour, self.learned.frame.point)
        self._taken = np.empty((0, 1 + 3 * model.arm.n))
        """Samples that later values rest on."""
        self._averaged = 0
        """How many samples go into one value; 0 before that is known."""
        self._next = -np.inf
        """Time of the next value [s]."""
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
        before = self._taken[-1, 0] if len(self._taken) else taken[0, 0] - LONGEST_GAP
        steps = np.diff(taken[:, 0], prepend=before)
        parted = np.flatnonzero((steps > LONGEST_GAP) | (steps <= 0.0))
        if len(parted):
            self.restart()
            taken = taken[parted[-1] :]
        values = self._even(taken)
        if not len(values):
            return []
        q, v, torque = values[:, 1 : 1 + n], values[:, 1 + n : 1 + 2 * n], values[:, 1 + 2 * n :]
        if not np.isfinite(v).all():
            first = q[:1] if self._last is None else self._last[None, 1 : 1 + n]
            v = np.diff(q, axis=0, prepend=first) * rate
        self._last = values[-1]
        calibration = listener.records.calibration
        if calibration is not None:
            q, v = calibration.angle(q), v * calibration.values("position_gain", 1.0)
        warmth = np.zeros_like(q)
        if temperature is not None and listener.warm is not None:
            warmth += np.nan_to_num(temperature - listener.warm)
        filtered = self._filter.rows(Samples(q, v, torque, warmth))
        if not len(filtered.by_link):
            return []
        when = values[filtered.chosen, 0]
        judged, events = self._detector.judge(when, listener.model.rows(filtered))
        self.row = ExternalRow(
            float(when[-1]), judged.external[-1], judged.std[-1], filtered.motion.part(slice(-1, None))
        )
        return events

    def _even(self, taken: Array) -> Array:
        """Rows (K, 1 + 3n) at even times, of all samples so far: means over a period where they come faster."""
        period = 1.0 / self.learned.listener.rate
        self._taken = rows = np.concatenate([self._taken, taken])
        if not self._averaged:
            if len(rows) < MEASURED_SAMPLES:
                return rows[:0]
            self._averaged = averaged_samples(rows[:, 0], self.learned.listener.rate)
        if len(rows) <= self._averaged:
            return rows[:0]
        means = rows
        if self._averaged > 1:
            means = np.lib.stride_tricks.sliding_window_view(rows, self._averaged, axis=0).mean(axis=-1)
        self._next = max(self._next, float(means[0, 0]))
        even = np.arange(self._next, means[-1, 0] + 1e-6 * period, period)
        if len(even):
            self._next = float(even[-1]) + period
        self._taken = rows[max(int(np.searchsorted(means[:, 0], self._next)) - 1, 0) :]
        place = np.clip(np.searchsorted(means[:, 0], even, side="right") - 1, 0, len(means) - 2)
        share = (even - means[place, 0]) / (means[place + 1, 0] - means[place, 0])
        return np.asarray(means[place] + share[:, None] * (means[place + 1] - means[place]))

    def wrench(self) -> Wrench | None:
        """Of the newest row at the frame learned for."""
        row, frame = self.row, self.learned.frame
        if row is None:
            return None
        precision = self.learned.listener.model.lasting.precision
        return wrench(row.motion, frame.link, frame.point, row.external[None], row.std[None], precision)
