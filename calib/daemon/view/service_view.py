"""The view of a service: its answers in the form of contract 8."""

from datetime import datetime
from typing import Any

from calib.daemon.loop.loop_messages import Batch
from calib.daemon.observer_feed import joints_now, number
from calib.daemon.proposal import proposal_answer
from calib.daemon.service import Service
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
from calib.daemon.view.view import NoSuch, NotPossible


class ServiceView:
    """What the web layer reads (`calib.daemon.view.view.DaemonView`)."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def status(self) -> Status:
        """State, bus and records."""
        service = self._service
        watcher = service.watcher
        now = service.around.monotonic()
        pending = sum(row.state == "pending" for row in service.journal.proposals())
        return Status(
            state=service.state,
            detail=service.trouble or service.fault or service.detail or service.silent,
            arm=service.arm.name,
            serial=service.arm.serial,
            version=service.version,
            policy=service.settings.policy,
            listen_only=service.listen_only,
            time=service.around.wall(),
            t=now,
            uptime_s=now - service.started,
            bus=self._bus(),
            records=RecordsInForce(
                calibration=None if service.calibration is None else service.calibration.id,
                gravity=None if service.gravity is None else service.gravity.id,
            ),
            held=watcher is not None and watcher.observer.held,
            rows=0 if watcher is None else watcher.observer.rows,
            pending_proposals=pending,
            last_event=service.journal.last_event,
            report=service.report,
        )

    def joints(self) -> tuple[JointNow, ...]:
        """Every joint as of the newest samples, base to tip."""
        service = self._service
        late = max(service.around.monotonic() - service.batch_at, 0.0) if service.batch is not None else 0.0
        return joints_now(service.names, service.batch, service.watcher, late)

    def estimates(self) -> tuple[JointEstimate, ...]:
        """Every joint's gain and offset, base to tip; empty while there is no gravity record."""
        service = self._service
        if service.watcher is None:
            return ()
        estimate = service.watcher.observer.estimate()
        gain, offset = (service.watcher.calibration.values(name) for name in ("gain", "offset"))
        return tuple(
            JointEstimate(
                joint=name,
                gain=estimate.gain[j],
                gain_std=estimate.gain_std[j],
                offset=estimate.offset[j],
                offset_std=estimate.offset_std[j],
                samples=estimate.accepted[j],
                last_accepted=service.accepted.get(name),
                installed_gain=number(gain[j]),
                installed_offset=number(offset[j]),
            )
            for j, name in enumerate(service.names)
        )

    def events(self, after: int = 0, limit: int = 500) -> tuple[EventRecord, ...]:
        """Events with a larger id, oldest first."""
        return tuple(EventRecord(**row) for row in self._service.journal.events(after, limit))

    def history(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> tuple[HistoryPoint, ...]:
        """Estimates over time, oldest first; raises NoSuch."""
        names = self._service.names
        if joint is not None and joint not in names:
            raise NoSuch(f"no joint {joint!r}; there are {', '.join(names)}")
        points = self._service.journal.history(since, until, most)
        wanted = range(len(names)) if joint is None else (names.index(joint),)
        return tuple(_point(names[j], j, *point) for j in wanted for point in points if len(point[3]["gain"]) > j)

    def proposals(self, limit: int = 200) -> tuple[Proposal, ...]:
        """Newest first."""
        return tuple(proposal_answer(row) for row in self._service.journal.proposals(limit))

    def approve(self, proposal: int, by: str) -> Proposal:
        """Put a pending proposal in force; raises NoSuch, NotPossible."""
        service = self._service
        if not service.connected:
            self._require(proposal)
            raise NotPossible(f"the bus is not there ({service.fault or 'starting'}): nothing can be written")
        if service.recalibrations is None:
            self._require(proposal)
            raise NotPossible(service.detail)
        return service.recalibrations.approve(proposal, by)

    def reject(self, proposal: int, by: str) -> Proposal:
        """Drop a pending proposal; raises NoSuch, NotPossible."""
        service = self._service
        if service.recalibrations is None:
            self._require(proposal)
            raise NotPossible(service.detail)
        return service.recalibrations.reject(proposal, by)

    def subscribe(self) -> Client:
        """A new client of the stream; it begins with the present joints."""
        client = self._service.hub.subscribe()
        client.put(self.snapshot())
        return client

    def snapshot(self) -> JointsItem:
        """The stream's item of now."""
        service = self._service
        return JointsItem(
            time=service.around.wall(),
            t=service.around.monotonic(),
            state=service.state,
            bus=self._bus(),
            joints=self.joints(),
        )

    def publish(self) -> None:
        """Give the stream its item: ten times a second, bus or no bus."""
        if self._service.hub.clients:
            self._service.hub.publish(self.snapshot())

    def _require(self, proposal: int) -> None:
        if self._service.journal.proposal(proposal) is None:
            raise NoSuch(f"no proposal {proposal}")

    def _bus(self) -> BusHealth:
        service = self._service
        stats = service.batch.stats if isinstance(service.batch, Batch) else None
        counted: dict[str, Any] = {}
        if stats is not None:
            names = ("rate_hz", "load", "frames", "missed", "late", "errors")
            counted = {name: getattr(stats, name) for name in names}
            if not service.connected:
                counted |= {"rate_hz": 0.0, "load": 0.0}
        return BusHealth(connected=bool(service.connected), fault=service.fault or service.silent or None, **counted)


def _point(
    joint: str, j: int, time: datetime, t: float, record: str | None, estimate: dict[str, list[float]]
) -> HistoryPoint:
    values = {name: estimate[name][j] for name in ("gain", "gain_std", "offset", "offset_std")}
    return HistoryPoint(time=time, t=t, joint=joint, record=record, **values)
