"""Are a joint's position readings those of a sound encoder? Judged while it moves, before anything relies on them."""

import numpy as np

from armlink.errors import Refused
from armlink.link.types import Sample
from calib.motion.encoder_bits import bit_of, missing_bit
from gcomp.arrays import Array, Mask

JUMP, JUMP_STEPS = 3.0, 4.0
"""A change of a position reading beyond this many times the speed limit, plus this many increments, is no motion."""


class EncoderFault(Refused):
    """A joint's position readings are none of a sound encoder."""

    def __init__(self, name: str, seen: str, bit: int | None) -> None:
        """Joint's name, what its readings did, and the bit that would do it."""
        cause = "its encoder or cable" if bit is None else f"bit {bit} of its encoder, which is stuck or lost"
        super().__init__(f"{name}: {seen}: repair {cause}: no calibration with it is valid")


class EncoderCheck:
    """Sees every sample, and at the end of each motion what was read on the way."""

    def __init__(self, names: tuple[str, ...], step: Array, speed: Array, now: float) -> None:
        """Of n joints whose readings change by at least `step` [rad], and that turn at most at `speed` [rad/s]."""
        self._names, self._step = names, step
        self._fastest, self._slack = JUMP * speed, JUMP_STEPS * step
        self._read_at = np.full(len(names), now)
        self._delay = 0.0
        self._unsure = np.zeros(len(names), dtype=bool)
        """Whether the last reading of each joint was not timely: nothing is said of the way from there."""

    def forget(self) -> None:
        """Restart after an interruption: nothing is said of what happened meanwhile."""
        self._unsure[:] = True

    def see(self, sample: Sample, before: Array) -> None:
        """Raise EncoderFault if a position reading differs from the last one `before` it (n,) [rad] by more than its
        joint can have turned meanwhile. Only timely readings count, and of those the time between their SYNCs and what
        it took them to come."""
        if sample.timely is not None:
            self._unsure |= ~sample.timely
        moved = sample.position - before
        elapsed = sample.t - self._read_at + max(sample.delay, self._delay)
        jumped = (np.abs(moved) > self._fastest * elapsed + self._slack) & ~self._unsure
        self._delay = sample.delay
        if np.count_nonzero(jumped):  # never of a reading that did not come: NaN
            joint = int(np.argmax(jumped))
            what = f"its position reading jumped by {moved[joint]:+.3g} rad between two cycles, which no motion does"
            raise EncoderFault(self._names[joint], what, bit_of(float(abs(moved[joint]) / self._step[joint])))
        came = np.isfinite(sample.position)
        np.copyto(self._read_at, sample.t, where=came)
        self._unsure &= ~(came if sample.timely is None else came & sample.timely)

    def judge(self, seen: Array, path: Array, movable: Mask, resolution: Array) -> None:
        """Raise EncoderFault where what a joint read on its way leaves out what one bit would have shown.

        seen (K, n) is what was read and path (K, n) where the `movable` joints were sent [rad]; `resolution` (n,) is
        the smallest change that was ever read, inf where none was: bits below it are never used.
        """
        if np.isnan(seen).any(axis=1).mean() > 0.02:  # too many cycles without timely readings
            return
        step = np.where(np.isfinite(resolution), resolution, self._step)
        for joint in np.flatnonzero(movable):
            counts = np.rint(seen[:, joint] / step[joint])
            bit = missing_bit(counts[np.isfinite(counts)], path[:, joint] / step[joint])
            if bit is not None:
                what = f"its position reading skips every other {2.0**bit * step[joint]:.3g} rad"
                unused = round(float(np.log2(step[joint] / self._step[joint])))
                raise EncoderFault(self._names[joint], what, bit + unused)
