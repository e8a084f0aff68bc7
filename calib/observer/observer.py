"""The observer: watches ordinary motion and says when a joint's torque sensor has drifted, and by how much.

Pure: samples in, events out; no bus, clock, file or thread. Readings are those of the installed calibration, so that
every estimate is relative to it: reading = gain·τ + offset with gain 1 and offset 0 while nothing has drifted.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.cause_test import CauseTest, Verdict
from calib.observer.config import ObserverConfig
from calib.observer.cusum import Cusum
from calib.observer.decision import Agreeing, Finding, agreed, decide
from calib.observer.effect_dictionary import Window
from calib.observer.events import Estimate, Event, verdict_evidence
from calib.observer.gravity_belief import ModelBelief
from calib.observer.pose_memory import Places
from calib.observer.rest_detector import RestDetector
from calib.observer.sensor_filter import SensorFilter
from calib.records.records import Array, CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm


class Observer:
    """`handle(sample)` → events; `estimate()`; `install(joint)` after a new calibration was written."""

    def __init__(
        self,
        arm: Arm,
        beta: Array,
        beta_covariance: Array,
        sigma: Array,
        config: ObserverConfig | None = None,
        position_gain: Array | None = None,
        position_offset: Array | None = None,
    ) -> None:
        """Watch an arm.

        beta (2n,) [kg·m] and its covariance (2n, 2n) as the gravity record has them; sigma (n,) [N·m], standard
        deviation of one averaged torque reading to begin with, which the readings themselves tell afterwards; position
        gains and offsets (n,) of the calibration record.
        """
        self.arm, self.config = arm, config or ObserverConfig()
        self.belief = ModelBelief(arm, beta, beta_covariance)
        self.sigma: Array = np.asarray(sigma, dtype=float)
        self._position_gain = np.ones(arm.n) if position_gain is None else position_gain
        self._position_offset = np.zeros(arm.n) if position_offset is None else position_offset
        self.rows = 0
        self.held = False
        """Whether an alarm stands: estimates are held until a verdict."""
        self.rest = RestDetector(arm.n, self.config)
        self.filter = SensorFilter(arm.n, self.config)
        self.cusum = Cusum(arm.n, self.config)
        self.places = Places(arm.n, self.config.place_size, self.config.places, self.config.place_memory)
        self.window: list[StaticReading] = []
        self.fresh = self.repeated = 0
        self.doubtful = False
        self.first: Agreeing | None = None
        self.said: tuple[str, tuple[int, ...]] | None = None
        self.reasons: tuple[str, ...] = ()
        self.learnt = self.carrying = 0
        self._proposed = np.full(arm.n, -np.inf)

    @classmethod
    def of_records(
        cls,
        arm: Arm,
        calibration: CalibrationRecord,
        gravity: GravityRecord,
        rated_torque: Array,
        config: ObserverConfig | None = None,
    ) -> "Observer":
        """Observer of an arm with these records in force; rated_torque (n,) [N·m] scales the noise assumed at first."""
        config = config or ObserverConfig()
        sigma = config.noise_share * np.asarray(rated_torque, dtype=float)
        position = (calibration.values("position_gain", 1.0), calibration.values("position_offset", 0.0))
        return cls(arm, np.array(gravity.beta), np.array(gravity.covariance), sigma, config, *position)

    def handle(self, t: float, position: Array, torque: Array) -> list[Event]:
        """Take one sample: readings (n,) in SI units, NaN where missing; returns what there is to say, if anything."""
        row = self.rest.handle(t, position, torque)
        return [] if row is None else self.handle_row(row)

    def handle_row(self, row: StaticReading) -> list[Event]:
        """Take one row: what `handle` makes of a stop."""
        self.rows += 1
        angle = self._position_gain * row.position + self._position_offset
        row = replace(row, position=angle)
        if np.isfinite(row.torque_error).all():
            weight = 1 / min(self.rows + self.config.noise_rows, self.config.noise_memory)
            self.sigma = np.sqrt((1 - weight) * self.sigma**2 + weight * row.torque_error**2)
        events = [] if self.held else self._watch(row)
        if events:
            self._start_test()
            return events
        if not self._is_new(row):
            return self._repeat(row.t)
        self.window.append(row)
        self.fresh += 1
        if self.fresh < (self.config.window if self.held else self.config.audit_rows):
            return []
        self.fresh = 0
        return self._test(row.t) if self.held else self._audit(row.t)

    def estimate(self) -> Estimate:
        """Gain and offset of every joint against the installed calibration, as known now."""
        gain_std, offset_std = np.sqrt(np.diagonal(self.filter.covariance, axis1=1, axis2=2)).T
        gain, offset = self.filter.state.T.copy()
        return Estimate(gain, gain_std, offset, offset_std, self.filter.accepted.copy())

    def install(self, finding: Finding) -> None:
        """The finding was written to the controller: from now on readings are right again, as far as it was known."""
        floor = np.diag([self.config.drift_gain**2, self.config.drift_offset**2])
        self.filter.restart(finding.joint, covariance=finding.covariance + floor)
        self.places.forget()
        self._resume()

    def _watch(self, row: StaticReading) -> list[Event]:
        """Filter and change detection; returns alarms."""
        q, noise = row.position, self.sigma**2
        torque = self.belief.torque(q[None])[0]
        of_model = self.belief.torque_variance(q, self.config.position_std)
        expected, left = self.places.expected(q, of_model, noise)
        alarms = self.cusum.handle(row.torque - torque - expected, torque, noise + left)
        if alarms:
            return [self._event(row.t, "alarm", joint, channel=channel) for joint, channel in alarms]
        if self.places.seen(q) < self.config.place_rows:
            self.filter.handle(row.torque, torque, noise + of_model)
        self.places.add(q, row.torque - torque)
        over = np.flatnonzero(self.filter.rejected >= self.config.outliers_in_a_row)
        return [self._event(row.t, "outliers", int(joint), rows=self.config.outliers_in_a_row) for joint in over]

    def _audit(self, t: float) -> list[Event]:
        """No alarm stands: test the last rows all the same, for what is too small or too slow for an alarm."""
        del self.window[: -self.config.longest_window]
        verdict = self.cause_test(self.window).verdict()
        if verdict.cause == "none":
            if self.learnt < self.config.baseline_rows:
                window = Window.of(self.window[-self.config.audit_rows :])
                self.belief.learn(window.position, window.torque, self.sigma)
                self.places.forget()
                self.learnt += self.config.audit_rows
            return []
        if verdict.cause in ("unknown", "ambiguous"):
            return []  # an alarm will come if it lasts
        self._start_test()
        return [self._event(t, "verdict", verdict.joint, **verdict_evidence(verdict, self.arm.names))]

    def _test(self, t: float) -> list[Event]:
        """An alarm stands and its window is full: say what it was, and propose where two windows agree on a drift."""
        test = self.cause_test(self.window)
        verdict = test.verdict()
        if verdict.cause == "ambiguous" and len(self.window) < self.config.longest_window:
            return []  # more rows may tell
        window, self.window = self.window, []
        doubted, self.doubtful = self.doubtful, verdict.cause == "unknown"
        if self.doubtful and not doubted:
            return []  # the cause may have changed within this window: one more
        if verdict.cause == "none":
            self._resume()
            return [self._event(t, "verdict", verdict.joint, **verdict_evidence(verdict, self.arm.names))]
        if not verdict.is_drift:
            self.first = None
            return self._carried(t, verdict) or self._say(t, verdict)
        self.carrying = 0
        return self._say(t, verdict) + self._confirm(t, window, test, verdict)

    def _carried(self, t: float, verdict: Verdict) -> list[Event]:
        """A payload that stays is a tool, one taken off again was none: the model takes it over, watching goes on."""
        self.carrying = self.carrying + 1 if verdict.cause == "payload" else 0
        if not self.carrying:
            return []
        mass, std = float(verdict.values[0]), float(np.sqrt(verdict.covariance[0, 0]))
        off = self.belief.mass > 0 and abs(mass + self.belief.mass) < 0.05 * self.belief.mass + 5 * std
        if self.carrying < self.config.tool_windows and not off:
            return []
        self.belief.carry(verdict.values, verdict.covariance)
        self.places.forget()
        self._resume()
        evidence = verdict_evidence(replace(verdict, cause="tool"), self.arm.names)
        return [self._event(t, "verdict", None, **evidence)]

    def _confirm(self, t: float, window: list[StaticReading], test: CauseTest, verdict: Verdict) -> list[Event]:
        """A window says drift: once another one before it agrees, decide on the rows of all that agree."""
        first, self.first = self.first, Agreeing(window, test, frozenset(verdict.joints))
        for joint in verdict.joints:
            change, covariance = test.drift(joint, verdict.cause, verdict.other(joint))
            self.filter.restart(joint, 1 + change[0], change[1], covariance)
        if first is None or first.joints != self.first.joints:
            return []
        for joint in verdict.joints:
            if not agreed(first.test, test, joint, verdict.other(joint), self.config.agreement):
                return self._undecided(t, joint, "two windows disagree: still drifting")
        rows = (first.rows + window)[-self.config.longest_window :]
        together = self.cause_test(rows)
        self.first = Agreeing(rows, together, first.joints)
        verdict = together.verdict()
        if not verdict.is_drift or frozenset(verdict.joints) != first.joints:
            return self._undecided(t, None, "all windows together say something else")
        return [event for joint in verdict.joints for event in self._decide(t, together, verdict, joint)]

    def _decide(self, t: float, test: CauseTest, verdict: Verdict, joint: int) -> list[Event]:
        """The estimate from all rows that agree, as a proposal or with what forbids it."""
        finding = decide(test, verdict, joint, self.config)
        self.filter.restart(joint, finding.gain, finding.offset, finding.covariance)
        if finding.refused:
            return self._undecided(t, joint, *finding.refused)
        if t - self._proposed[joint] < self.config.rest_between_writes:
            return []
        self._proposed[joint] = t
        std = dict(zip(("gain_std", "offset_std"), finding.std, strict=True))
        evidence = {"gain": finding.gain, "offset": finding.offset, **std, "rows": finding.rows}
        return [replace(self._event(t, "proposal", joint, **evidence), finding=finding)]

    def cause_test(self, rows: list[StaticReading]) -> CauseTest:
        """The cause test of these rows, by what is believed now."""
        return CauseTest(self.belief, Window.of(rows), self.sigma, self.config)

    def _start_test(self) -> None:
        self._clear()
        self.held = True

    def _resume(self) -> None:
        self._clear()
        self.held = False
        self.cusum.reset()

    def _clear(self) -> None:
        self.said, self.first, self.doubtful, self.reasons = None, None, False, ()
        self.window, self.fresh, self.repeated = [], 0, 0
        self.carrying = 0

    def _is_new(self, row: StaticReading) -> bool:
        """Whether the window has few enough rows of this place that one more would not only wind it up."""
        away = [np.abs(kept.position - row.position).max() for kept in self.window]
        return sum(bool(far < self.config.place_size) for far in away) < self.config.place_rows

    def _repeat(self, t: float) -> list[Event]:
        """One more row of a place that the window knows: too many of them under an alarm, and no test is possible."""
        self.repeated += self.held
        if self.repeated < self.config.patience:
            return []
        self._clear()
        return self._undecided(t, None, "too few different poses to tell a cause: sweep, or move more")

    def _undecided(self, t: float, joint: int | None, *reasons: str) -> list[Event]:
        """Why nothing is proposed, once as long as it stays the same."""
        before, self.reasons = self.reasons, reasons
        return [] if before == reasons else [self._event(t, "undecided", joint, reasons=list(reasons))]

    def _say(self, t: float, verdict: Verdict) -> list[Event]:
        """The verdict's event, once as long as it stays the same."""
        said, self.said = self.said, (verdict.cause, verdict.joints)
        return (
            []
            if said == self.said
            else [self._event(t, "verdict", verdict.joint, **verdict_evidence(verdict, self.arm.names))]
        )

    def _event(self, t: float, kind: str, joint: int | None, **evidence: Any) -> Event:
        return Event(t, kind, None if joint is None else self.arm.names[joint], evidence)
