"""The observer: watches ordinary motion and reports when a joint's torque sensor has drifted, and by how much.

Pure: samples in, events out; no bus, clock, file or thread. Readings are those of the installed calibration, and every
estimate is relative to it: reading = gain·τ + offset, with gain 1 and offset 0 while nothing has drifted.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from calib.motion.static_reading import StaticReading
from calib.observer.cause_test import CauseTest, DetectionLimits
from calib.observer.config import AUDIT_ROWS, LONGEST_WINDOW, ObserverConfig
from calib.observer.decision import Agreeing, DriftFinding, Event, decide, verdict_evidence, windows_agree
from calib.observer.discrepancy import DiscrepancyLevel
from calib.observer.evidence import Verdict
from calib.observer.gravity_belief import GravityBelief
from calib.observer.investigation import DOUBTED, Investigation, audit, is_confirmed
from calib.observer.moving_observer import MovingObserver
from calib.observer.rest_detector import RestDetector
from calib.observer.saved_values import UNREADABLE, restored
from calib.observer.tracking import Estimate, Tracking
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array

SCHEMA = 1
"""Version of the saved format."""
DISCREPANCY_SHARE = 5e-4
"""Discrepancy of the gravity model expected before the first row, as a share of rated torque; if the calibration says
how large it is, that counts."""
PATIENCE = 2 * LONGEST_WINDOW
"""Repeated poses after an alarm after which the test is given up as undecided: as many as two longest windows have."""


class Observer:
    """`handle(sample)` → events; `estimate()`; `install(finding)` after a new calibration was written."""

    def __init__(
        self,
        arm: Arm,
        beta: Array,
        beta_covariance: Array,
        sigma: Array,
        config: ObserverConfig | None = None,
        angle: Callable[[Array], Array] = lambda reading: reading,
        level: DiscrepancyLevel | None = None,
    ) -> None:
        """Watch an arm.

        beta (2n,) [kg·m] and its covariance (2n, 2n) as the gravity record has them; sigma (n,) [N·m], standard
        deviation of one averaged torque reading to begin with, replaced by the measured one; `angle` makes joint
        angles of position readings, as the calibration record does; level of the discrepancy that the calibration left,
        if it said.
        """
        self.arm, self.config = arm, config or ObserverConfig()
        self._angle = angle
        self._rest = RestDetector(arm.n, self.config)
        rated, settings = np.asarray(sigma, dtype=float) / self.config.noise_share, self.config
        expected = level or DiscrepancyLevel.expected(DISCREPANCY_SHARE * rated)
        wander = settings.zero_wander * rated
        belief = GravityBelief(
            arm, beta, beta_covariance, settings.position_std, expected, settings.baseline_rows, wander
        )
        self._tracking = Tracking(belief, sigma, self.config)
        self._investigation = Investigation(arm.n, self.config)
        self._proposed = np.full(arm.n, -np.inf)
        self._limits: tuple[tuple[int, ...], DetectionLimits] | None = None

    @property
    def rows(self) -> int:
        return self._tracking.rows

    @property
    def accepted(self) -> Array:
        return self._tracking.filter.accepted.copy()

    @property
    def held(self) -> bool:
        """Whether an alarm is open: estimates are held until a verdict."""
        return self._investigation.held and not self._investigation.silent

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[Event]:
        """Take one sample: readings (n,) in SI units, NaN if missing; returns events, usually none.

        temperature (n,) [°C] as the drives tell it; NaN or None where they do not.
        """
        row = self._rest.handle(t, position, torque)
        if row is None:
            return []
        return self.handle_row(row if temperature is None else replace(row, temperature=temperature))

    def handle_row(self, row: StaticReading) -> list[Event]:
        """Take one row: the average over one stop, as the rest detector makes it."""
        row = replace(row, position=self._angle(row.position))
        if not self._tracking.count(row):
            return []
        alarms = [] if self._investigation.held else self._tracking.watch(row)
        if alarms:
            told = [alarm for alarm in alarms if alarm[0] != "suspicion"]
            self._investigation.start(silent=not told)
            return [self._event(row.t, kind, joint, **evidence) for kind, joint, evidence in told]
        if not self._investigation.add(row):
            return self._repeat(row.t)
        if not self._investigation.is_due():
            return []
        if self._investigation.held:
            return self._test(row.t)
        audit(self._tracking, self._investigation, self.config)
        return []

    def estimate(self) -> Estimate:
        return self._tracking.filter.estimate()

    def limits(self) -> DetectionLimits:
        """The changes of each joint that would be noticed now, at poses like the latest ones."""
        key = (self._tracking.rows // AUDIT_ROWS, self._tracking.belief.learnt, self._tracking.belief.level.rows)
        if self._limits is None or self._limits[0] != key:
            self._limits = (key, self._tracking.limits(self._investigation.window[-LONGEST_WINDOW:]))
        return self._limits[1]

    def model_torque(self, position: Array) -> Array:
        """Gravity torque [N·m] that the observer believes at position readings [rad]; (n,), or (K, n) of K poses."""
        torque: Array = self._tracking.belief.torque(np.atleast_2d(self._angle(position)))
        return torque.reshape(position.shape)

    def install(self, finding: DriftFinding) -> None:
        """The finding was written to the controller: readings are correct again within the finding's uncertainty."""
        self._tracking.install(finding)
        self._resume()

    def save(self) -> dict[str, Any]:
        """State of all parts as JSON values, without times, since clocks restart with the machine."""
        return {"schema": SCHEMA} | self._tracking.save() | self._rest.save() | self._investigation.save()

    def restore(self, values: dict[str, Any]) -> bool:
        """Continue from saved values of the same arm and records; False, and nothing changed, if they do not fit."""
        investigation = copy(self._investigation)
        try:
            if values["schema"] != SCHEMA:
                return False
            tracking, rest = restored(self._tracking, values), restored(self._rest, values)
            investigation.restore(values, tracking.cause_test)
        except UNREADABLE:
            return False
        self._tracking, self._rest, self._investigation = tracking, rest, investigation
        return True

    def _test(self, t: float) -> list[Event]:
        """An alarm is open and its window is full: report the cause; propose once two windows agree on a drift."""
        state = self._investigation
        test = self._tracking.cause_test(state.window)
        # rows that nothing explains show the discrepancy rather than a contact, for which an alarm is open
        adapts = not self._tracking.belief.learnt or len(state.window) >= DOUBTED * self.config.window
        if state.silent and test.verdict().cause == "unknown" and adapts:
            self._tracking.adapt(state.window)
            test = self._tracking.cause_test(state.window)
        verdict = test.verdict()
        if verdict.cause == "ambiguous" and len(state.window) < LONGEST_WINDOW:
            return []  # more rows may decide
        if state.silent and not is_confirmed(self._tracking, state, test, verdict):
            return []
        found, state.silent = state.silent and verdict.is_drift, False
        window, state.window = state.window, []
        state.doubtful = state.doubtful + 1 if verdict.cause == "unknown" else 0
        if state.doubtful == 1:
            return []  # the cause may have changed within this window: wait for another one
        if state.doubtful > DOUBTED:  # it stays: another discrepancy than the one known
            self._tracking.adapt(window)
            test = self._tracking.cause_test(window)
            verdict = test.verdict()
        if verdict.cause == "none":
            self._resume()
            return [self._verdict(t, verdict)]
        if not verdict.is_drift:
            state.first = None
            return self._carried(t, verdict) or self._report(t, verdict)
        state.carrying = 0
        alarms = [self._event(t, "alarm", joint, channel=verdict.cause) for joint in verdict.joints if found]
        return alarms + self._report(t, verdict) + self._confirm(t, window, test, verdict)

    def _carried(self, t: float, verdict: Verdict) -> list[Event]:
        """A payload that stays is a tool: the model takes it over and watching resumes; likewise when it is removed."""
        state, belief = self._investigation, self._tracking.belief
        state.carrying = state.carrying + 1 if verdict.cause == "payload" else 0
        if not state.carrying:
            return []
        mass, std = float(verdict.values[0]), float(np.sqrt(verdict.covariance[0, 0]))
        off = belief.mass > 0 and abs(mass + belief.mass) < 0.05 * belief.mass + 5 * std
        if state.carrying < self.config.tool_windows and not off:
            return []
        self._tracking.carry(verdict.values, verdict.covariance)
        self._resume()
        return [self._verdict(t, replace(verdict, cause="tool", joint=None))]

    def _confirm(self, t: float, window: list[StaticReading], test: CauseTest, verdict: Verdict) -> list[Event]:
        """A window found a drift: once the window before it agrees, decide on the rows of both."""
        first, agreeing = self._investigation.first, Agreeing(window, test, frozenset(verdict.joints))
        self._investigation.first = agreeing
        for joint in verdict.joints:
            change, covariance = test.drift(joint, verdict.cause, verdict.other(joint))
            self._tracking.filter.restart(joint, 1 + change[0], change[1], covariance)
        if first is None or first.joints != agreeing.joints:
            return []
        for joint in verdict.joints:
            if not windows_agree(first.test, test, joint, verdict.other(joint)):
                return self._undecided(
                    t, joint, "two windows of readings disagree, so the sensor may still be drifting"
                )
        rows = (first.rows + window)[-LONGEST_WINDOW:]
        together = self._tracking.cause_test(rows)
        self._investigation.first = Agreeing(rows, together, first.joints)
        verdict = together.verdict()
        if not verdict.is_drift or frozenset(verdict.joints) != first.joints:
            return self._undecided(
                t,
                None,
                "each window of readings shows a drift of the sensor, but all windows together show another cause",
            )
        return [event for joint in verdict.joints for event in self._decide(t, together, verdict, joint)]

    def _decide(self, t: float, test: CauseTest, verdict: Verdict, joint: int) -> list[Event]:
        """The estimate from all rows that agree, as a proposal or with the reasons against one."""
        finding = decide(test, verdict, joint, self.config)
        self._tracking.filter.restart(joint, finding.gain, finding.offset, finding.covariance)
        if finding.refused:
            return self._undecided(t, joint, *finding.refused)
        if t - self._proposed[joint] < self.config.rest_between_writes:
            return []
        self._proposed[joint] = t
        std = dict(zip(("gain_std", "offset_std"), finding.std, strict=True))
        evidence = {"gain": finding.gain, "offset": finding.offset, **std, "rows": finding.rows}
        return [replace(self._event(t, "proposal", joint, **evidence), finding=finding)]

    def _resume(self) -> None:
        self._investigation.resume()
        self._tracking.resume()

    def _repeat(self, t: float) -> list[Event]:
        """A pose that the window has already; too many of them under an alarm make a test impossible."""
        state = self._investigation
        state.repeated += self.held
        if state.repeated < PATIENCE:
            return []
        state.clear()
        return self._undecided(
            t, None, "the arm stood in too few different poses to find a cause: more poses are needed"
        )

    def _undecided(self, t: float, joint: int | None, *reasons: str) -> list[Event]:
        """The reasons why nothing is proposed, reported when they change."""
        before, self._investigation.reasons = self._investigation.reasons, reasons
        return [] if before == reasons else [self._event(t, "undecided", joint, reasons=list(reasons))]

    def _report(self, t: float, verdict: Verdict) -> list[Event]:
        """The verdict as an event, reported when it changes."""
        before, now = self._investigation.reported, (verdict.cause, verdict.joints)
        self._investigation.reported = now
        return [] if before == now else [self._verdict(t, verdict)]

    def _verdict(self, t: float, verdict: Verdict) -> Event:
        return self._event(t, "verdict", verdict.joint, **verdict_evidence(verdict, self.arm.names))

    def _event(self, t: float, kind: str, joint: int | None, **evidence: Any) -> Event:
        return Event(t, kind, None if joint is None else self.arm.names[joint], evidence)


AnyObserver = Observer | MovingObserver


def observer_of(
    arm: Arm,
    calibration: CalibrationRecord,
    gravity: GravityRecord,
    rated_torque: Array,
    config: ObserverConfig | None = None,
) -> AnyObserver:
    """The observer that suits the arm of these records: of rests, or, where torque is a motor current, of motion.

    rated_torque (n,) [N·m] scales the noise assumed at first. Records of drives whose torque is a current have their
    friction.
    """
    if any(joint.motor is not None for joint in calibration.joints):
        return MovingObserver(arm, calibration, gravity, rated_torque)
    config, rated = config or ObserverConfig(), np.asarray(rated_torque, dtype=float)
    level = DiscrepancyLevel.of_record(calibration, DISCREPANCY_SHARE * rated)
    beta, covariance = np.array(gravity.beta), np.array(gravity.covariance)
    return Observer(arm, beta, covariance, config.noise_share * rated, config, calibration.angle, level)
