"""The service as the web layer sees it: implements `calib.daemon.view.view.DaemonView`."""

import math
from collections.abc import Iterator
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from armlink.link.joints.groups import state_name
from calib.daemon.observing.observation import Observation
from calib.daemon.service import Service
from calib.daemon.state.history_reader import HistoryReader
from calib.daemon.view.api_models import (
    BusHealth,
    EventRecord,
    HistoryPoint,
    JointEstimate,
    JointNow,
    JointsItem,
    Proposal,
    RecordsInForce,
    Status,
)
from calib.daemon.view.fan_out import Client
from calib.daemon.view.view import Decisions, NoSuch


class ServiceView:
    """Answers from the service's parts; see `DaemonView`."""

    def __init__(self, service: Service) -> None:
        self._service, self._version = service, version("armlink")
        self._history = HistoryReader(service.journal.path)
        self.decisions: Decisions = service.recalibrations

    @property
    def _observation(self) -> Observation | None:
        return self._service.records.observation

    def status(self) -> Status:
        """State, bus and records."""
        service, observation = self._service, self._observation
        arm_state, configuration, now = service.arm_state, service.configuration, service.environment.monotonic()
        return Status(
            state=service.state,
            detail=service.trouble or arm_state.fault or service.records.detail or arm_state.silent,
            arm=configuration.arm.name,
            serial=configuration.arm.serial,
            version=self._version,
            policy=configuration.settings.policy,
            listen_only=configuration.listen_only,
            time=service.environment.wall(),
            t=now,
            uptime_s=now - service.started,
            bus=self._bus(),
            records=RecordsInForce(
                calibration=None if observation is None else observation.feed.calibration.id,
                gravity=None if observation is None else observation.feed.gravity.id,
            ),
            uncalibrated=arm_state.uncalibrated,
            held=observation is not None and observation.feed.observer.held,
            rows=0 if observation is None else observation.feed.observer.rows,
            pending_proposals=service.journal.pending(),
            store_fault=service.records.store_fault or None,
            journal_fault=service.journal.trouble or None,
            last_event=service.journal.last_event,
            report=_newest_report(service.directory),
        )

    def joints(self) -> tuple[JointNow, ...]:
        """Every joint as of the newest samples, base to tip."""
        names, arm_state = self._service.configuration.names, self._service.arm_state
        batch = arm_state.batch
        if batch is None:
            return tuple(_joint(name, math.nan, math.nan, math.nan, "unknown", math.inf) for name in names)
        position, torque = batch.channels["position"][-1], batch.channels["torque"][-1]
        model = np.full(len(names), math.nan)
        if self._observation is not None:
            torque = self._observation.feed.reading(torque)
            if np.isfinite(position).all():
                model = self._observation.feed.observer.model_torque(position)
        arm = self._service.configuration.arm
        states = [state_name(arm, joint, code) for joint, code in enumerate(batch.status.tolist())]
        columns = zip(names, position, torque, model, states, batch.age + arm_state.late, strict=True)
        return tuple(_joint(*column) for column in columns)

    def estimates(self) -> tuple[JointEstimate, ...]:
        """Every joint's gain and offset, base to tip; empty while there is no gravity record."""
        if self._observation is None:
            return ()
        feed, last_accepted = self._observation.feed, self._observation.last_accepted
        estimate, limits = feed.observer.estimate(), feed.observer.limits()
        gain, offset = (feed.calibration.values(name) for name in ("gain", "offset"))
        return tuple(
            JointEstimate(
                joint=name,
                gain=estimate.gain[j],
                gain_std=estimate.gain_std[j],
                offset=estimate.offset[j],
                offset_std=estimate.offset_std[j],
                samples=estimate.accepted[j],
                last_accepted=last_accepted.get(name),
                installed_gain=_number(gain[j]),
                installed_offset=_number(offset[j]),
                gain_limit=_number(limits.gain[j]),
                offset_limit=_number(limits.offset[j]),
                limit_rests=limits.rests,
            )
            for j, name in enumerate(feed.names)
        )

    def events(self, after: int = 0, limit: int = 500) -> tuple[EventRecord, ...]:
        """Events with a larger id, oldest first."""
        return tuple(EventRecord(**row) for row in self._service.journal.events(after, limit))

    def history(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> tuple[HistoryPoint, ...]:
        """Estimates over time, oldest first; raises NoSuch."""
        return tuple(point for page in self.history_pages(joint, since, until, most) for point in page)

    def history_pages(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> Iterator[tuple[HistoryPoint, ...]]:
        """Likewise in pieces; raises NoSuch at the first."""
        names, reader = self._service.configuration.names, self._history
        if joint is not None and joint not in names:
            raise NoSuch(f"no joint {joint!r}; there are {', '.join(names)}")
        chosen = reader.chosen(since, until, most)
        for j in range(len(names)) if joint is None else (names.index(joint),):
            for page in reader.pages(chosen):
                yield tuple(_point(names[j], j, *point) for point in page if len(point[3]["gain"]) > j)

    def proposals(self, limit: int = 200) -> tuple[Proposal, ...]:
        """Newest first."""
        return tuple(row.answer() for row in self._service.journal.proposals(limit))

    def subscribe(self) -> Client:
        """A new client of the stream; it begins with the present joints."""
        client = self._service.hub.subscribe()
        client.put(self.snapshot())
        return client

    def snapshot(self) -> JointsItem:
        """The present joints as an item of the stream."""
        environment = self._service.environment
        return JointsItem(
            time=environment.wall(),
            t=environment.monotonic(),
            state=self._service.state,
            bus=self._bus(),
            joints=self.joints(),
        )

    def publish(self) -> None:
        """Give the stream its item: ten times a second, bus or no bus."""
        if self._service.hub.clients:
            self._service.hub.publish(self.snapshot())

    def _bus(self) -> BusHealth:
        arm_state = self._service.arm_state
        counted: dict[str, Any] = {}
        if arm_state.batch is not None:
            names = ("rate_hz", "load", "frames", "missed", "late", "errors")
            counted = {name: getattr(arm_state.batch.stats, name) for name in names}
            if not arm_state.connected:
                counted |= {"rate_hz": 0.0, "load": 0.0}
        fault = arm_state.fault or arm_state.silent or None
        return BusHealth(connected=bool(arm_state.connected), fault=fault, **counted)


def _newest_report(directory: Path) -> Path | None:
    try:
        reports = [path for path in directory.glob("*.html") if path.is_file()]
        return max(reports, key=lambda path: path.stat().st_mtime, default=None)
    except OSError:  # removed meanwhile, or the disk fails
        return None


def _number(value: float) -> float | None:
    value = float(value)
    return value if math.isfinite(value) else None


def _joint(name: str, position: float, torque: float, model: float, state: str, age: float) -> JointNow:
    return JointNow(
        joint=name,
        position=_number(position),
        torque=_number(torque),
        model_torque=_number(model),
        residual=_number(torque - model),
        state=state,
        sample_age_s=_number(age),
    )


def _point(
    joint: str, j: int, time: datetime, t: float, record: str | None, estimate: dict[str, list[float]]
) -> HistoryPoint:
    values = {name: estimate[name][j] for name in ("gain", "gain_std", "offset", "offset_std")}
    return HistoryPoint(time=time, t=t, joint=joint, record=record, **values)
