"""From an alarm to a decision: the rows gathered for the next cause test, and the results of the tests before it.

While no alarm is open, audits test the last rows for effects too small or too slow for an alarm, or learn from them.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.cause_test import CauseTest
from calib.observer.config import AUDIT_ROWS, LONGEST_WINDOW, PLACE_SIZE, ObserverConfig
from calib.observer.decision import Agreeing
from calib.observer.evidence import Verdict
from calib.observer.saved_values import read_rows, save_rows
from calib.observer.tracking import PLACE_ROWS, Tracking


class Investigation:
    """Progress from an alarm to a decision; with no alarm, the rows of the next audit."""

    def __init__(self, n: int, config: ObserverConfig) -> None:
        self._n, self._config = n, config
        self.held = False
        """Whether an alarm is open: estimates are held until a verdict."""
        self.silent = False
        """Whether it was opened by an audit, and fresh rows have not confirmed what that found."""
        self.clear()

    def clear(self) -> None:
        self.window: list[StaticReading] = []
        self.fresh = self.repeated = self.carrying = 0
        """New rows since the last test; repeated poses; consecutive windows that found the same payload."""
        self.learned = 0
        """Rows at the front of the window that are reference already; only without an alarm."""
        self.doubtful = 0
        """Windows in a row that had no single cause."""
        self.first: Agreeing | None = None
        """Rows that found a drift, to be confirmed by the next window."""
        self.suspected: tuple[str, tuple[int, ...]] | None = None
        """Cause and joints that fresh rows have found once; only while it is silent."""
        self.reported: tuple[str, tuple[int, ...]] | None = None
        """The last verdict reported: cause and joints."""
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
        if self.window:
            away = np.abs(np.array([kept.position for kept in self.window]) - row.position).max(axis=1)
            if (away < PLACE_SIZE).sum() >= PLACE_ROWS:
                return False
        self.window.append(row)
        self.fresh += 1
        return True

    def is_due(self) -> bool:
        """Whether there are rows enough for the next test; if so their count starts again."""
        due = self.fresh >= (self._config.window if self.held else AUDIT_ROWS)
        if due:
            self.fresh = 0
        return due

    def settled(self, first: bool) -> list[StaticReading]:
        """Rows of the window, found free of drift, that become reference now; cuts the window to its length.

        While the reference's first epoch is open (`first`) all but the newest; afterwards those that leave the window,
        so that a window is tested against rows of another time.
        """
        leaving = max(0, len(self.window) - LONGEST_WINDOW)
        upto = max(leaving, len(self.window) - AUDIT_ROWS) if first else leaving
        rows = self.window[self.learned : upto]
        del self.window[:leaving]
        self.learned = max(self.learned, upto) - leaving
        return rows

    def save(self) -> dict[str, Any]:
        first, said = self.first, self.reported
        return {
            "held": self.held,
            "silent": self.silent,
            "carrying": self.carrying,
            "doubtful": self.doubtful,
            "learned": self.learned,
            "window": save_rows(self.window),
            "fresh": self.fresh,
            "repeated": self.repeated,
            "first": None if first is None else {"rows": save_rows(first.rows), "joints": sorted(first.joints)},
            "suspected": None if self.suspected is None else [self.suspected[0], list(self.suspected[1])],
            "said": None if said is None else [said[0], list(said[1])],
            "reasons": list(self.reasons),
        }

    def restore(self, values: dict[str, Any], cause_test: Callable[[list[StaticReading]], CauseTest]) -> None:
        """`cause_test` makes the test of the rows to be confirmed, by the restored belief."""
        self.window, first, said = read_rows(values["window"], self._n), values["first"], values["said"]
        self.first = None
        if first is not None:
            rows = read_rows(first["rows"], self._n)
            self.first = Agreeing(rows, cause_test(rows), frozenset(map(int, first["joints"])))
        self.reported = None if said is None else (str(said[0]), tuple(said[1]))
        suspected = values.get("suspected")
        self.suspected = None if suspected is None else (str(suspected[0]), tuple(suspected[1]))
        self.fresh, self.repeated, self.carrying = (int(values[name]) for name in ("fresh", "repeated", "carrying"))
        self.held, self.doubtful, self.reasons = bool(values["held"]), int(values["doubtful"]), tuple(values["reasons"])
        self.learned, self.silent = int(values.get("learned", 0)), bool(values.get("silent", False))


DOUBTED = 2
"""Windows in a row that nothing explains after which the level of the discrepancy is adapted to them.

An alarm is open, or the first epoch of the reference."""


def audit(tracking: Tracking, state: Investigation, config: ObserverConfig) -> None:
    """Test the last rows: those free of any effect become reference; an effect opens a silent investigation."""
    window = state.window[-LONGEST_WINDOW:]
    if not tracking.belief.learnt:
        if len(window) < config.window:
            return
        tracking.adapt(window[: -len(window) // 4])  # a change in the newest rows is not discrepancy
    verdict = tracking.cause_test(window).verdict()
    if verdict.cause == "unknown":
        state.doubtful += 1
        # longer than a change takes to fill the window; an alarm would be open if it were a contact
        patience = DOUBTED if tracking.belief.is_first else LONGEST_WINDOW // AUDIT_ROWS + 1
        if state.doubtful >= patience:
            tracking.adapt(window)
            verdict = tracking.cause_test(window).verdict()
    state.doubtful = state.doubtful if verdict.cause == "unknown" else 0
    if verdict.cause == "none":
        tracking.learn(state.settled(tracking.belief.is_first))
        return
    del state.window[:-LONGEST_WINDOW]
    state.learned = min(state.learned, len(state.window))
    if verdict.cause not in ("unknown", "ambiguous"):  # an alarm follows if those last
        state.start(silent=True)


def is_confirmed(tracking: Tracking, state: Investigation, test: CauseTest, verdict: Verdict) -> bool:
    """Whether fresh rows twice find what an audit or a suspicion was about; nothing is told before."""
    if verdict.cause in ("none", "unknown", "ambiguous"):
        if len(state.window) >= LONGEST_WINDOW:
            state.resume()
            tracking.resume()
        return False
    suspected, state.suspected = state.suspected, ("drift" if verdict.is_drift else verdict.cause, verdict.joints)
    if suspected == state.suspected:
        return True
    state.first = Agreeing(state.window, test, frozenset(verdict.joints)) if verdict.is_drift else None
    state.window = []
    return False
