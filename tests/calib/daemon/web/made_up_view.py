"""A daemon's view that tests fill by hand: what the web layer does must not depend on a bus."""

import math
from concurrent.futures import Future
from datetime import UTC, datetime, timedelta

import numpy as np

from armlink.arm_file import load_arm
from calib.daemon import view
from calib.daemon.service_view import drawn_arm
from calib.daemon.view import Client, Hub, NoSuch, NotPossible, Window

NOW = datetime(2026, 5, 1, 8, 0, tzinfo=UTC)
NAMES = tuple(f"joint_{i}" for i in range(1, 8))


class MadeUpView:
    """Seven joints at rest; `tick()` publishes one item, `happen()` an event."""

    def __init__(self) -> None:
        self.hub = Hub()
        self.begin()

    def begin(self) -> None:
        """As it is at the start."""
        self.state, self.fault, self.t = view.State.OBSERVING, None, 0.0
        self.report = None
        self.disk_hangs = False
        self.log: list[view.EventRecord] = []
        self.contacts: list[view.ExternalEvent] = []
        self.points: list[view.HistoryPoint] = []
        self.offered: list[view.Proposal] = []
        self.shift = 0.0
        self.moves = True

    def tick(self, seconds: float = 0.1) -> None:
        self.t += seconds
        self.hub.publish(self.item())

    def happen(self, kind: str, joint: str | None = None, text: str = "", **evidence: object) -> view.EventRecord:
        record = view.EventRecord(
            id=len(self.log) + 1, time=self.time(), t=self.t, kind=kind, joint=joint, text=text, evidence=evidence
        )
        self.log.append(record)
        self.hub.publish(view.EventItem(event=record))
        return record

    def propose(self, joint: str = "joint_2") -> view.Proposal:
        proposal = view.Proposal(
            id=len(self.offered) + 1,
            hash=f"{len(self.offered) + 1:064x}",
            time=self.time(),
            state="pending",
            joint=joint,
            cause="gain",
            gain=1.013,
            gain_std=0.0006,
            offset=0.004,
            offset_std=0.012,
            rows=40,
            confidence=0.998,
            record="1f0c9a2b",
            base="77aa01cd",
        )
        self.offered.insert(0, proposal)
        return proposal

    def time(self) -> datetime:
        return NOW + timedelta(seconds=self.t)

    def item(self) -> view.JointsItem:
        return view.JointsItem(
            time=self.time(), t=self.t, state=self.state, bus=self.bus(), joints=self.joints(), wrench=self.wrench(),
            load=0.0,
        )  # fmt: skip

    def wrench(self) -> view.ExternalWrench:
        """Six joints do not show the moment about x."""
        return view.ExternalWrench(
            joint=NAMES[-1], point=(0.0, 0.0, 0.1), force=(0.4 + 40.0 * self.shift, -0.2, 1.1),
            force_std=(0.8, 0.7, 1.2), moment=(None, 0.1, -0.05), moment_std=(None, 0.2, 0.1),
        )  # fmt: skip

    def touch(self) -> view.ExternalEvent:
        """A contact, told at once."""
        contact = view.ExternalEvent(
            time=self.time(), kind="contact", joints=(NAMES[1], NAMES[0]), link=NAMES[3], probability=0.82,
            least_force=9.4, mass=0.0,
        )  # fmt: skip
        self.contacts.append(contact)
        self.hub.publish(view.ContactItem(contact=contact))
        return contact

    def bus(self) -> view.BusHealth:
        if self.fault:
            return view.BusHealth(connected=False, fault=self.fault)
        return view.BusHealth(connected=True, rate_hz=250.0, load=0.42, frames=1200 + int(self.t * 4000), missed=0)

    def status(self) -> view.Status:
        return view.Status(
            state=self.state,
            detail=self.fault or "",
            arm="sarcos",
            serial="SIM-0001",
            version="0.1.0",
            policy="propose",
            listen_only=False,
            time=self.time(),
            t=self.t,
            uptime_s=self.t,
            bus=self.bus(),
            records=view.RecordsInForce(calibration="77aa01cd", gravity="0b5c11ee"),
            rows=120,
            pending_proposals=sum(each.state == "pending" for each in self.offered),
            last_event=len(self.log),
            report=self.report,
        )

    def joints(self) -> tuple[view.JointNow, ...]:
        return tuple(
            view.JointNow(
                joint=name,
                position=0.3 * math.sin(self.t * self.moves + k),
                torque=5.0 * math.cos(self.t + k) + 0.02 + self.shift * (k == 1),
                model_torque=5.0 * math.cos(self.t + k),
                residual=0.02 + self.shift * (k == 1),
                temperature=31.0 + k,
                state="operation enabled",
                sample_age_s=None if self.fault else 0.004,
                external_torque=0.1 + self.shift * (k == 1),
                external_bound=0.4,
            )
            for k, name in enumerate(NAMES)
        )

    def external(self) -> view.ExternalNow:
        joints = self.joints()
        torque, bound = (tuple(getattr(joint, f"external_{name}") for joint in joints) for name in ("torque", "bound"))
        return view.ExternalNow(
            reason="", age_s=0.02, baseline_s=600.0, torque=torque, bound=bound, wrench=self.wrench(), load=0.0,
            events=tuple(self.contacts), counts={"contact": len(self.contacts)},
        )  # fmt: skip

    def window(self, seconds: float, most: int) -> Window:
        """A swing since the start, of the torques alone if nothing `moves`."""
        first = max(0.0, self.t - seconds)
        t = np.linspace(first, self.t, min(most, 1 + round(10 * (self.t - first))))
        phase = t[:, None] + np.arange(len(NAMES))
        model = 5.0 * np.cos(phase)
        channels = {
            "position": 0.3 * np.sin(phase if self.moves else phase - t[:, None]),
            "torque": model + 0.02,
            "model_torque": model,
            "temperature": np.full(phase.shape, 31.0) + np.arange(len(NAMES)),
        }
        channels["temperature"][:, 0] = np.nan
        return Window(NAMES, self.time(), t - t[0], channels)

    def arm(self) -> view.DrawnArm:
        return drawn_arm(load_arm("sarcos"))

    def estimates(self) -> tuple[view.JointEstimate, ...]:
        return tuple(
            view.JointEstimate(
                joint=name,
                gain=1.0 + 0.012 * (k == 1),
                gain_std=0.001,
                offset=0.01,
                offset_std=0.02,
                samples=120,
                last_accepted=NOW,
                installed_gain=1.04,
                installed_offset=0.3,
            )
            for k, name in enumerate(NAMES)
        )

    def events(self, after: int = 0, limit: int = 500) -> tuple[view.EventRecord, ...]:
        return tuple(event for event in self.log if event.id > after)[:limit]

    def history(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> tuple[view.HistoryPoint, ...]:
        if joint is None:
            return tuple(point for name in NAMES for point in self.history(name, since, until, most))
        if joint not in NAMES:
            raise NoSuch(f"no joint {joint!r}; expected one of {', '.join(NAMES)}")
        points = [point for point in self.points if point.joint == joint]
        points = [p for p in points if (since is None or p.time >= since) and (until is None or p.time <= until)]
        return tuple(points[:: max(1, math.ceil(len(points) / most))])

    def history_pages(self, *query):
        yield self.history(*query)

    def proposals(self, limit: int = 200) -> tuple[view.Proposal, ...]:
        return tuple(self.offered[:limit])

    def approve(self, proposal: int, by: str, digest: str | None = None) -> Future[view.Proposal]:
        return self._decide(proposal, "approved", by, digest)

    def reject(self, proposal: int, by: str, digest: str | None = None) -> Future[view.Proposal]:
        return self._decide(proposal, "rejected", by, digest)

    def subscribe(self) -> Client:
        client = self.hub.subscribe()
        client.add(self.item())
        return client

    def _decide(self, number: int, state: str, by: str, digest: str | None) -> Future[view.Proposal]:
        answer: Future[view.Proposal] = Future()
        for place, proposal in enumerate(self.offered):
            if proposal.id == number:
                if digest not in (None, proposal.hash):
                    raise NotPossible(f"proposal {number} does not have the hash {digest}")
                if proposal.state != "pending":
                    raise NotPossible(f"proposal {number} is already {proposal.state}")
                update = {"state": state, "decided_by": by, "decided_at": self.time()}
                self.offered[place] = proposal.model_copy(update=update)
                if not self.disk_hangs:
                    answer.set_result(self.offered[place])
                return answer
        raise NoSuch(f"no proposal {number}")
