"""The observer: watches ordinary work and reports when something has changed since the calibration, and by how much.

Pure: samples in, events out; no bus, clock, file or thread. Readings are those of the installed calibration, and every
estimate is relative to it: reading = gain·τ + offset, with gain 1 and offset 0 while nothing has drifted.

Arms with torque sensors are watched at rest, others in motion; only rows and belief differ. Only sensors can be put
right by a proposal: the torque constant of a motor is measured again by creep sweeps.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.fit.calibration import USUAL_ROWS
from calib.motion.static_reading import StaticReading
from calib.observer.alarms import PLACE_ROWS, AlarmWatch
from calib.observer.cause_test import Belief, CauseTest, DetectionLimits, cause_test, limits
from calib.observer.config import (
    AUDIT_ROWS,
    INITIAL_GAIN_STD,
    INITIAL_OFFSET_STD,
    LONGEST_WINDOW,
    ObserverConfig,
    WindowSizes,
)
from calib.observer.decision import WIDER, DriftFinding, Event, decide, verdict_evidence, windows_agree
from calib.observer.discrepancy import DiscrepancyLevel
from calib.observer.evidence import Verdict
from calib.observer.gravity_belief import GravityBelief
from calib.observer.investigation import Investigation
from calib.observer.motor_belief import MotorBelief
from calib.observer.row_makers import MotionDetector, RestDetector
from calib.observer.saved_values import UNREADABLE, restored
from calib.records.records import CalibrationRecord, GravityRecord
from gcomp.arm.arm import Arm
from gcomp.arrays import Array, as_array

SCHEMA = 1
"""Version of the saved format."""
FORMER_SCHEMA = "moving/1"
"""Of what observers in motion saved up to version 0.2."""
DISCREPANCY_SHARE = 5e-4
"""Discrepancy that is expected of an arm whose calibration tells nothing of it, as a share of rated torque."""
PATIENCE = 2 * LONGEST_WINDOW
"""Repeated poses after an alarm after which the test is given up as undecided: as many as two longest windows have."""
IN_MOTION = WindowSizes(LONGEST_WINDOW, LONGEST_WINDOW, 2 * LONGEST_WINDOW, overlap=LONGEST_WINDOW)
"""A row of motion has one torque, a rest one of each joint. Of seven joints that creep in turn, 60 rows are 40 s."""
DOUBTED = 2
"""Windows in a row that nothing explains until the discrepancy's level is adapted to them, or an open alarm is told so.
"""
NOISE_MEMORY = 200
"""Rows that the measured standard deviation is averaged over: known within 5 % by then."""
STEADY, CHANCE = 8.0, 3.0
"""The two halves of a rest's average may differ by this many standard deviations of it, and do by chance at most."""


@dataclass(frozen=True)
class Estimate:
    """Gain and offset of every joint against the installed calibration, with standard deviations; (n,) each."""

    gain: Array
    gain_std: Array
    offset: Array
    """[N·m]"""
    offset_std: Array
    accepted: Array
    """Rows that went into each."""

    def as_json(self) -> dict[str, list[float]]:
        """All but `accepted`, as lists."""
        return {name: getattr(self, name).tolist() for name in ("gain", "gain_std", "offset", "offset_std")}


class Observer:
    """`handle(sample)` → events; `estimate()`; `install(finding)` after a new calibration was written."""

    def __init__(
        self,
        belief: Belief,
        row_maker: RestDetector | MotionDetector,
        sizes: WindowSizes,
        config: ObserverConfig,
        angle: Callable[[Array], Array],
    ) -> None:
        """`angle` makes joint angles of position readings, as the calibration record does."""
        self.arm, self.config, n = belief.arm, config, belief.arm.n
        self._belief, self._row_maker, self._sizes, self._angle = belief, row_maker, sizes, angle
        self._alarms = AlarmWatch(n, config)
        self._investigation = Investigation(n, sizes)
        self.rows = 0
        """Rows taken."""
        self._state: Array = np.tile([1.0, 0.0], (n, 1))
        """Newest estimates of gains and offsets [N·m] (n, 2)."""
        self._covariance: Array = np.tile(np.diag([INITIAL_GAIN_STD**2, INITIAL_OFFSET_STD**2]), (n, 1, 1))
        """Of these (n, 2, 2)."""
        self._accepted = np.zeros(n, dtype=int)
        self._proposed = np.full(n, -np.inf)
        self._limits: tuple[tuple[int, ...], DetectionLimits] | None = None

    @classmethod
    def at_rest(
        cls,
        arm: Arm,
        beta: Array,
        beta_covariance: Array,
        sigma: Array,
        config: ObserverConfig | None = None,
        angle: Callable[[Array], Array] = lambda reading: reading,
        level: DiscrepancyLevel | None = None,
    ) -> "Observer":
        """Watch an arm with torque sensors.

        beta (2n,) [kg·m] and its covariance (2n, 2n) as the gravity record has them; sigma (n,) [N·m], standard
        deviation of one averaged torque reading to begin with, replaced by the measured one; level of the discrepancy
        that the calibration left, if it said.
        """
        config = config or ObserverConfig()
        rated = np.asarray(sigma, dtype=float) / config.noise_share
        expected = level or DiscrepancyLevel.expected(DISCREPANCY_SHARE * rated)
        wander, first = config.zero_wander * rated, config.baseline_rows
        belief = GravityBelief(arm, beta, beta_covariance, config.position_std, expected, first, wander, sigma)
        sizes = WindowSizes(config.window, AUDIT_ROWS, LONGEST_WINDOW, at_a_place=PLACE_ROWS)
        return cls(belief, RestDetector(arm.n, config), sizes, config, angle)

    @classmethod
    def in_motion(
        cls, arm: Arm, calibration: CalibrationRecord, gravity: GravityRecord, rated_torque: Array
    ) -> "Observer":
        """Watch an arm whose torque is a motor current, against records of creep sweeps; rated_torque (n,) [N·m]."""
        belief = MotorBelief(arm, calibration, gravity, np.asarray(rated_torque, dtype=float))
        return cls(belief, MotionDetector(arm.n), IN_MOTION, ObserverConfig(), calibration.angle)

    @property
    def accepted(self) -> Array:
        return self._accepted.copy()

    @property
    def held(self) -> bool:
        """Whether an alarm of a sensor is open: estimates are held until a verdict."""
        return self._belief.of_sensors and self._investigation.held and not self._investigation.silent

    def handle(self, t: float, position: Array, torque: Array, temperature: Array | None = None) -> list[Event]:
        """Take one sample: readings (n,) in SI units, NaN if missing; returns events, usually none.

        temperature (n,) [°C] as the drives tell it; NaN or None where they do not.
        """
        rows = self._row_maker.handle(t, position, torque, temperature)
        return [event for row in rows for event in self.handle_row(row)]

    def handle_row(self, row: StaticReading) -> list[Event]:
        """Take one row, as the row maker makes it."""
        row, state = replace(row, position=self._angle(row.position)), self._investigation
        if not self._is_steady(row):
            return []
        self.rows += 1
        if isinstance(self._belief, GravityBelief) and not state.held:
            alarms = self._alarms.watch(row, self._belief)
            if alarms:
                told = [alarm for alarm in alarms if alarm[0] == "alarm"]
                state.start(silent=not told)
                return [self._event(row.t, "alarm", joint, channel=channel) for _, joint, channel in told]
        if not state.add(row):
            return self._repeat(row.t)
        if not self.held:
            self._accepted += row.counted
        if not state.is_due():
            return []
        return self._test(row.t) if state.held else self._audit(row.t)

    def estimate(self) -> Estimate:
        (gain, offset), std = self._state.T.copy(), np.sqrt(np.diagonal(self._covariance, axis1=1, axis2=2))
        return Estimate(gain, std[:, 0], offset, std[:, 1], self.accepted)

    def limits(self) -> DetectionLimits:
        """The changes of each joint that would be noticed now, in work like the latest; NaN if that tells none."""
        belief, sizes, rows = self._belief, self._sizes, self._investigation.latest()
        key = (self.rows // sizes.audit, belief.learnt)
        if self._limits is None or self._limits[0] != key:
            wait = 0 if belief.is_known else max(0, sizes.window - self.rows)
            anywhere = belief.anywhere(sizes.longest)
            if len(rows) >= sizes.window:
                self._limits = key, limits(cause_test(belief, rows), sizes, wait)
            elif anywhere is not None:
                self._limits = key, limits(CauseTest(belief, anywhere), sizes, wait)
        if self._limits is None:
            nothing = np.full(self.arm.n, np.nan)
            return DetectionLimits(nothing, nothing, sizes.longest + 2 * sizes.window)
        return self._limits[1]

    def model_torque(self, position: Array) -> Array:
        """Gravity torque [N·m] that the observer believes at position readings [rad]; (n,), or (K, n) of K poses."""
        torque: Array = self._belief.torque(np.atleast_2d(self._angle(position)))
        return torque.reshape(position.shape)

    def install(self, finding: DriftFinding) -> None:
        """The finding was written to the controller: readings are correct again within the finding's uncertainty."""
        self._set(finding.joint, np.zeros(2), finding.covariance)
        self._belief.close()
        self._alarms.forget_poses()
        self._resume()

    def save(self) -> dict[str, Any]:
        """State of all parts as JSON values, without times, since clocks restart with the machine."""
        own = {
            "schema": SCHEMA,
            "rows": self.rows,
            "state": self._state.tolist(),
            "covariance": self._covariance.tolist(),
            "accepted": self._accepted.tolist(),
        }
        parts = (self._belief, self._alarms, self._row_maker, self._investigation)
        return own | {name: value for part in parts for name, value in part.save().items()}

    def restore(self, values: dict[str, Any]) -> bool:
        """Continue from saved values of the same arm and records; False, and nothing changed, if they do not fit."""
        again, n = copy(self), self.arm.n
        try:
            if values["schema"] == FORMER_SCHEMA:
                values = self.save() | _of_motion(values, n)
            if values["schema"] != SCHEMA:
                return False
            again.rows = int(values["rows"])
            again._state = as_array("state", values["state"], (n, 2))
            again._covariance = as_array("covariance", values["covariance"], (n, 2, 2))
            again._accepted = as_array("accepted", values["accepted"], (n,)).astype(int)
            again._belief = restored(self._belief, values)
            again._alarms, again._row_maker = restored(self._alarms, values), restored(self._row_maker, values)
            again._investigation = restored(self._investigation, values)
        except UNREADABLE:
            return False
        again._limits = None
        vars(self).update(vars(again))
        return True

    # ---- without an alarm

    def _is_steady(self, row: StaticReading) -> bool:
        """Average a rest's measured noise into sigma; False if its torque was not steady.

        Such a row is not of a rest: a motion begins in it, or a load changes. Sigma grows by what it may at most have
        been by chance, so that rows of an arm that has become noisier count again after a while.
        """
        if not np.isfinite(row.torque_error).all():
            return True
        sigma = self._belief.sigma
        steady = bool((row.torque_error <= STEADY * sigma).all())
        error = np.minimum(row.torque_error, CHANCE * sigma)
        weight = 1 / min(self.rows + steady + USUAL_ROWS, NOISE_MEMORY)
        self._belief.sigma = np.sqrt((1 - weight) * sigma**2 + weight * error**2)
        return steady

    def _audit(self, t: float) -> list[Event]:
        """Test the last rows for effects too small or too slow for an alarm.

        Those free of any effect become reference; an effect opens a silent investigation.
        """
        state, belief, sizes, window = self._investigation, self._belief, self._sizes, self._investigation.latest()
        if not belief.learnt and belief.of_sensors:
            if len(window) < sizes.window:
                return []
            self._adapt(window[: -len(window) // 4])  # a change in the newest rows is not discrepancy
        # longer than a change takes to fill the window; an alarm would be open if it were a contact
        patience = DOUBTED if belief.is_first else sizes.longest // sizes.audit + 1
        test, verdict = self._judge(window, patience)
        if verdict.cause == "none":
            self._learn(state.settled(belief.is_first))
            if len(window) >= min(sizes.longest, self._accepted.max()):  # else an alarm or a write was not long ago
                self._estimate(test)
            gone, state.reported = state.reported is not None, None
            return [self._verdict(t, verdict)] if gone else []
        state.cut(sizes.longest)
        if verdict.cause not in ("unknown", "ambiguous"):  # an alarm follows if those last
            state.start(silent=True)
            if sizes.overlap:
                self._is_repeated(verdict)
        elif verdict.cause == "unknown" and state.doubtful >= patience and not belief.is_first:
            return self._report(t, verdict)
        return []

    # ---- under an alarm

    def _test(self, t: float) -> list[Event]:
        """An alarm is open and its window is full: report the cause; propose once two windows agree on a drift."""
        state, belief, sizes = self._investigation, self._belief, self._sizes
        # without an alarm that was told, rows that nothing explains show the discrepancy rather than a contact
        test, verdict = self._judge(state.window, DOUBTED if state.silent else DOUBTED + 1)
        if verdict.cause == "ambiguous" and len(state.window) < sizes.longest:
            return []  # more rows may decide
        if verdict.cause == "none" and state.reported and not test.denies(*state.reported, state.size):
            state.cut(sizes.longest)
            return []  # these rows do not show the change that was found, nor that it is gone
        if state.silent and not self._is_confirmed(verdict):
            return []
        found, state.silent = state.silent and verdict.is_drift, False
        window = state.window
        state.cut(sizes.overlap)
        if state.doubtful == 1:
            return []  # the cause may have changed within this window: wait for another one
        if not belief.of_sensors:
            self._estimate(test)
            if verdict.cause == "ambiguous" or not self._is_repeated(verdict):
                return []  # windows overlap
        if verdict.cause == "none":
            self._resume()
            return [self._verdict(t, verdict)]
        if not belief.of_sensors:
            return self._report(t, verdict)
        if not verdict.is_drift:
            state.suspected, state.first = None, []
            return self._carried(t, verdict) or self._report(t, verdict)
        state.carrying = 0
        alarms = [self._event(t, "alarm", joint, channel=verdict.cause) for joint in verdict.joints if found]
        return alarms + self._report(t, verdict) + self._confirm(t, window, test, verdict)

    def _is_confirmed(self, verdict: Verdict) -> bool:
        """Whether fresh rows twice find what an audit or a suspicion was about; nothing is told before."""
        state = self._investigation
        if verdict.cause in ("none", "unknown", "ambiguous"):
            if len(state.window) >= self._sizes.longest:
                self._resume()
            return False
        if self._is_repeated(verdict):
            return True
        state.first = state.window if verdict.is_drift else []
        state.cut(self._sizes.overlap)
        return False

    def _is_repeated(self, verdict: Verdict) -> bool:
        """Whether the window before found the same."""
        state, sensors = self._investigation, self._belief.of_sensors
        before, cause = state.suspected, "drift" if sensors and verdict.is_drift else verdict.cause
        state.suspected = (cause, tuple(sorted(verdict.joints)))
        return state.suspected == before

    def _carried(self, t: float, verdict: Verdict) -> list[Event]:
        """A payload that stays is a tool: the model takes it over and watching resumes; likewise when it is removed."""
        state, belief = self._investigation, self._belief
        state.carrying = state.carrying + 1 if verdict.cause == "payload" else 0
        if not state.carrying or not isinstance(belief, GravityBelief):
            return []
        mass, std = float(verdict.values[0]), float(np.sqrt(verdict.covariance[0, 0]))
        off = belief.mass > 0 and abs(mass + belief.mass) < 0.05 * belief.mass + 5 * std
        if state.carrying < self.config.tool_windows and not off:
            return []
        belief.carry(verdict.values, verdict.covariance)
        self._alarms.forget_poses()
        self._resume()
        return [self._verdict(t, replace(verdict, cause="tool", joint=None))]

    def _confirm(self, t: float, window: list[StaticReading], test: CauseTest, verdict: Verdict) -> list[Event]:
        """A window found a drift: once the window before it agrees, decide on the rows of both."""
        first, self._investigation.first = self._investigation.first, window
        for joint in verdict.joints:
            self._set(joint, *test.drift(joint, verdict.cause, verdict.other(joint)))
        if not self._is_repeated(verdict) or not first:
            return []
        before, joints = self._cause_test(first), set(verdict.joints)
        for joint in verdict.joints:
            if not windows_agree(before, test, joint, verdict.other(joint)):
                return self._undecided(
                    t, joint, "two windows of readings disagree, so the sensor may still be drifting"
                )
        self._investigation.first = rows = (first + window)[-LONGEST_WINDOW:]
        together = self._cause_test(rows)
        verdict = together.verdict()
        if not verdict.is_drift or set(verdict.joints) != joints:
            return self._undecided(
                t,
                None,
                "each window of readings shows a drift of the sensor, but all windows together show another cause",
            )
        return [event for joint in verdict.joints for event in self._decide(t, together, verdict, joint)]

    def _decide(self, t: float, test: CauseTest, verdict: Verdict, joint: int) -> list[Event]:
        """The estimate from all rows that agree, as a proposal or with the reasons against one."""
        finding = decide(test, verdict, joint, self.config)
        self._set(joint, np.array([finding.gain - 1, finding.offset]), finding.covariance)
        if finding.refused:
            return self._undecided(t, joint, *finding.refused)
        if t - self._proposed[joint] < self.config.rest_between_writes:
            return []
        self._proposed[joint] = t
        std = dict(zip(("gain_std", "offset_std"), finding.std, strict=True))
        evidence = {"gain": finding.gain, "offset": finding.offset, **std, "rows": finding.rows}
        return [replace(self._event(t, "proposal", joint, **evidence), finding=finding)]

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

    # ---- inside

    def _cause_test(self, rows: list[StaticReading]) -> CauseTest:
        return cause_test(self._belief, rows)

    def _judge(self, rows: list[StaticReading], patience: int) -> tuple[CauseTest, Verdict]:
        """Test rows; that nothing explains so many windows in a row shows another discrepancy than the one known."""
        state, test = self._investigation, self._cause_test(rows)
        verdict = test.verdict()
        state.doubtful = state.doubtful + 1 if verdict.cause == "unknown" else 0
        if state.doubtful >= patience:
            self._adapt(rows)
            test = self._cause_test(rows)
            verdict = test.verdict()
            state.doubtful = state.doubtful if verdict.cause == "unknown" else 0
        return test, verdict

    def _learn(self, rows: list[StaticReading]) -> None:
        if rows:
            self._belief.learn(rows)
            self._alarms.forget_poses()

    def _adapt(self, rows: list[StaticReading]) -> None:
        self._belief.adapt(rows)
        self._alarms.forget_poses()

    def _estimate(self, test: CauseTest) -> None:
        """Gains and offsets of all joints as the rows of a test have them."""
        wider = 1 + WIDER * test.known.of_model
        for joint in range(self.arm.n):
            change, covariance = test.sensor(joint)
            self._set(joint, change, wider[joint] * covariance)

    def _set(self, joint: int, change: Array, covariance: Array) -> None:
        self._state, self._covariance = self._state.copy(), self._covariance.copy()
        self._state[joint], self._covariance[joint] = np.array([1.0, 0.0]) + change, covariance

    def _resume(self) -> None:
        self._investigation.resume()
        self._alarms.resume()

    def _undecided(self, t: float, joint: int | None, *reasons: str) -> list[Event]:
        """The reasons why nothing is proposed, reported when they change."""
        before, self._investigation.reasons = self._investigation.reasons, reasons
        return [] if before == reasons else [self._event(t, "undecided", joint, reasons=list(reasons))]

    def _report(self, t: float, verdict: Verdict) -> list[Event]:
        """The verdict as an event, reported when it changes."""
        state = self._investigation
        before, now = state.reported, (verdict.cause, verdict.joints)
        state.reported, state.size = now, verdict.values
        return [] if before == now else [self._verdict(t, verdict)]

    def _verdict(self, t: float, verdict: Verdict) -> Event:
        of_motor = {} if self._belief.of_sensors else {"motor": True}
        return self._event(t, "verdict", verdict.joint, **verdict_evidence(verdict, self.arm.names), **of_motor)

    def _event(self, t: float, kind: str, joint: int | None, **evidence: Any) -> Event:
        return Event(t, kind, None if joint is None else self.arm.names[joint], evidence)


def observer_of(
    arm: Arm,
    calibration: CalibrationRecord,
    gravity: GravityRecord,
    rated_torque: Array,
    config: ObserverConfig | None = None,
) -> Observer:
    """The observer that suits the arm of these records: of rests, or, where torque is a motor current, of motion.

    rated_torque (n,) [N·m] scales the noise assumed at first. Records of drives whose torque is a current have their
    friction.
    """
    if any(joint.motor is not None for joint in calibration.joints):
        return Observer.in_motion(arm, calibration, gravity, rated_torque)
    config, rated = config or ObserverConfig(), np.asarray(rated_torque, dtype=float)
    level = DiscrepancyLevel.of_record(calibration, DISCREPANCY_SHARE * rated)
    beta, covariance = np.array(gravity.beta), np.array(gravity.covariance)
    return Observer.at_rest(arm, beta, covariance, config.noise_share * rated, config, calibration.angle, level)


def _of_motion(values: dict[str, Any], n: int) -> dict[str, Any]:
    """The former format of an observer in motion as the present one."""
    cause, joint, size = values["reported"]
    if not (joint is None or 0 <= joint < n):
        raise ValueError(f"joint {joint} of {n}")
    return {
        "schema": SCHEMA,
        "rows": sum(values["count"]),
        "accepted": values["count"],
        "learnt": values["learnt"],
        "window": [*values["recent"], *values["block"]],
        "fresh": len(values["block"]),
        "held": cause not in ("none", "unknown"),
        "said": None if cause == "none" else [cause, [] if joint is None else [joint]],
        "size": size,
    }
