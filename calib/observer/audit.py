"""Audits while no alarm is open: the last rows tested for effects too small or too slow for an alarm, or learned."""

from calib.motion.static_reading import StaticReading
from calib.observer.cause_test import CauseTest
from calib.observer.config import AUDIT_ROWS, LONGEST_WINDOW, ObserverConfig
from calib.observer.decision import Agreeing
from calib.observer.evidence import Verdict
from calib.observer.investigation import Investigation
from calib.observer.tracking.tracking import Tracking

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


def may_adapt(tracking: Tracking, window: list[StaticReading], config: ObserverConfig) -> bool:
    """Whether rows that nothing explains show the discrepancy rather than a contact, for which an alarm is open."""
    return not tracking.belief.learnt or len(window) >= DOUBTED * config.window


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
