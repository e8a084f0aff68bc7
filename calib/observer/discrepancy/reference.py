"""Reference rows: what the sensors, as installed, said at the poses of quiet work."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.observer.saved_values import known
from gcomp.arrays import Array, as_array

EPOCH_ROWS = 40
"""Rows of one epoch after the first: a minute or two, in which a drift of 0.5 % an hour is 0.02 %."""
EPOCHS = 2
"""Later epochs kept, the newest ones. With the first one they are 240 rows, and cost 30 ms to take in."""
ROWS = ("position", "residual", "side", "temperature", "epoch")


@dataclass(frozen=True)
class Rows:
    """N rows: pose [rad], reading less gravity model [N·m], side of approach and temperature [°C], (N, n) each; epoch
    (N,)."""

    position: Array
    residual: Array
    side: Array
    temperature: Array
    epoch: Array

    def __len__(self) -> int:
        return len(self.epoch)

    def __getitem__(self, kept: Any) -> "Rows":
        return Rows(*(getattr(self, name)[kept] for name in ROWS))

    def and_then(self, *more: Array, epoch: int) -> "Rows":
        """The same and more rows of one epoch: position, residual, side and temperature (K, n)."""
        columns = {name: np.vstack([getattr(self, name), column]) for name, column in zip(ROWS[:-1], more, strict=True)}
        return Rows(**columns, epoch=np.append(self.epoch, np.full(len(more[0]), epoch)))


class Reference:
    """The first epoch, which stays and which drift is measured against, and the newest later ones.

    A slow drift cannot pass for discrepancy: the first epoch ends after `most` rows, and later ones tell nothing of a
    gain or an offset (`Posterior`).
    """

    def __init__(self, n: int, most: int) -> None:
        """n joints; `most` rows in the first epoch."""
        self._most = most
        empty = np.empty((0, n))
        self.rows = Rows(empty, empty, empty, empty, np.empty(0, dtype=int))
        """In use."""
        self._pending = self.rows
        self._epoch = 0

    @property
    def is_first(self) -> bool:
        return self._epoch == 0

    @property
    def temperature(self) -> Array:
        """That the zeros are measured against (n,) [°C]: of the first row; NaN if it was not told."""
        return self.rows.temperature[0] if len(self.rows) else np.full(self.rows.position.shape[1], np.nan)

    def add(self, *more: Array) -> bool:
        """Take rows: position, residual, side and temperature (K, n); whether `rows` is another now."""
        if self.is_first:
            self.rows = self.rows.and_then(*more, epoch=0)
            self._epoch = int(len(self.rows) >= self._most)
            return True
        self._pending = self._pending.and_then(*more, epoch=self._epoch)
        if len(self._pending) < EPOCH_ROWS:
            return False
        kept = self.rows[(self.rows.epoch == 0) | (self.rows.epoch > self._epoch - EPOCHS)]
        new = self._pending
        self.rows = kept.and_then(new.position, new.residual, new.side, new.temperature, epoch=self._epoch)
        self._pending, self._epoch = new[:0], self._epoch + 1
        return True

    def close(self) -> None:
        """A sensor was corrected, or a tool taken over: what follows is another epoch."""
        self._epoch += int(self.is_first or len(self._pending) > 0)
        self._pending = self._pending[:0]

    def forget(self) -> None:
        """Begin again: the discrepancy has changed."""
        self.rows, self._pending, self._epoch = self.rows[:0], self._pending[:0], 0

    def before(self, position: Array) -> Rows:
        """The rows before the one of this pose (n,): all of them if it is not there."""
        same = np.flatnonzero((self.rows.position == position).all(axis=1))
        return self.rows[: same[0]] if len(same) else self.rows

    def save(self) -> dict[str, Any]:
        values = {name: [known(getattr(rows, name)) for rows in (self.rows, self._pending)] for name in ROWS}
        return {"reference": {**values, "open": self._epoch}}

    def restore(self, values: dict[str, Any]) -> None:
        """Older states have none."""
        n = self.rows.position.shape[1]
        if "reference" not in values:
            self.forget()
            return
        saved = values["reference"]
        rows = [_read({name: saved[name][part] for name in ROWS if name in saved}, n) for part in (0, 1)]
        (self.rows, self._pending), self._epoch = rows, int(saved["open"])


def _read(saved: dict[str, Any], n: int) -> Rows:
    """Rows from JSON values; raises one of UNREADABLE."""
    epoch = as_array("epoch", saved["epoch"], (len(saved["epoch"]),)).astype(int)
    position, residual, side = (
        as_array(name, np.reshape(saved[name], (-1, n)), (len(epoch), n)) for name in ("position", "residual", "side")
    )
    untold = np.full((len(epoch), n), np.nan)  # states of before it was kept
    told = np.reshape(np.array(saved.get("temperature", untold), dtype=float), (-1, n))
    return Rows(position, residual, side, as_array("temperature", told, (len(epoch), n), finite=False), epoch)
