"""From an alarm to a decision: the rows gathered for the next cause test, and the results of the tests before it."""

from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.config import PLACE_SIZE, WindowSizes
from calib.observer.saved_values import read_rows, save_rows
from gcomp.arrays import Array, as_array


class Investigation:
    """Progress from an alarm to a decision; with no alarm, the rows of the next audit."""

    def __init__(self, n: int, sizes: WindowSizes) -> None:
        self._n, self._sizes = n, sizes
        self.held = False
        """Whether an alarm is open: estimates are held until a verdict."""
        self.silent = False
        """Whether it was opened by an audit, and fresh rows have not confirmed what that found."""
        self.window: list[StaticReading] = []
        self.learned = 0
        """Rows at the front of the window that are reference already; only without an alarm."""
        self.clear()

    def clear(self) -> None:
        self.cut(self._sizes.overlap)
        self.fresh = self.repeated = self.carrying = 0
        """New rows since the last test; repeated poses; consecutive windows that found the same payload."""
        self.doubtful = 0
        """Windows in a row that had no single cause."""
        self.suspected: tuple[str, tuple[int, ...]] | None = None
        """Cause and joints that the window before found, to be confirmed by the next one."""
        self.first: list[StaticReading] = []
        """Its rows if it was a drift."""
        self.reported: tuple[str, tuple[int, ...]] | None = None
        """The last verdict reported: cause and joints."""
        self.size: Array = np.empty(0)
        """Its parameters."""
        self.reasons: tuple[str, ...] = ()
        """The last reasons reported for not deciding."""

    def start(self, silent: bool = False) -> None:
        """Begin with fresh rows: an alarm, or (silent) an audit that found something."""
        self.clear()
        self.held, self.silent = True, silent

    def resume(self) -> None:
        """End: the cause is known and dealt with."""
        self.clear()
        self.held = self.silent = False

    def add(self, row: StaticReading) -> bool:
        """Take a row; False if the window has enough rows of this pose already."""
        most = self._sizes.at_a_place
        if self.window and most is not None:
            away = np.abs(np.array([kept.position for kept in self.window]) - row.position).max(axis=1)
            if (away < PLACE_SIZE).sum() >= most:
                return False
        self.window.append(row)
        self.fresh += 1
        return True

    def is_due(self) -> bool:
        """Whether there are rows enough for the next test; if so their count starts again."""
        due = self.fresh >= (self._sizes.window if self.held else self._sizes.audit)
        if due:
            self.fresh = 0
        return due

    def latest(self) -> list[StaticReading]:
        """The rows of a test without an alarm."""
        return self.window[-self._sizes.longest :]

    def cut(self, count: int) -> None:
        """Cut the window to so many rows, the newest: to its overlap where the next one begins."""
        leaving = max(0, len(self.window) - count)
        self.window, self.learned = self.window[leaving:], max(0, self.learned - leaving)

    def settled(self, first: bool) -> list[StaticReading]:
        """Rows of the window, found free of drift, that become reference now; cuts the window to its length.

        While the reference's first epoch is open (`first`) all but the newest; afterwards those that leave the window,
        so that a window is tested against rows of another time.
        """
        leaving = max(0, len(self.window) - self._sizes.longest)
        upto = max(leaving, len(self.window) - self._sizes.audit) if first else leaving
        rows = self.window[self.learned : upto]
        del self.window[:leaving]
        self.learned = max(self.learned, upto) - leaving
        return rows

    def save(self) -> dict[str, Any]:
        said, suspected = self.reported, self.suspected
        joints = [] if suspected is None else list(suspected[1])
        return {
            "held": self.held,
            "silent": self.silent,
            "carrying": self.carrying,
            "doubtful": self.doubtful,
            "learned": self.learned,
            "window": save_rows(self.window),
            "fresh": self.fresh,
            "repeated": self.repeated,
            "first": {"rows": save_rows(self.first), "joints": joints} if self.first else None,
            "suspected": None if suspected is None else [suspected[0], joints],
            "said": None if said is None else [said[0], list(said[1])],
            "size": self.size.tolist(),
            "reasons": list(self.reasons),
        }

    def restore(self, values: dict[str, Any]) -> None:
        """States of before `suspected` was kept have it in `first`."""
        self.window, first, said = read_rows(values["window"], self._n), values["first"], values["said"]
        self.first = [] if first is None else read_rows(first["rows"], self._n)
        self.reported = None if said is None else (str(said[0]), tuple(said[1]))
        self.size = as_array("size", np.array(values.get("size", []), dtype=float), (None,))
        suspected = values.get("suspected") or (None if first is None else ["drift", first["joints"]])
        self.suspected = None if suspected is None else (str(suspected[0]), tuple(map(int, suspected[1])))
        self.fresh, self.repeated, self.carrying = (int(values[name]) for name in ("fresh", "repeated", "carrying"))
        self.held, self.doubtful, self.reasons = bool(values["held"]), int(values["doubtful"]), tuple(values["reasons"])
        self.learned, self.silent = int(values.get("learned", 0)), bool(values.get("silent", False))
