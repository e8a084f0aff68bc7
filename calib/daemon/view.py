"""The interface of the service to the web layer: the API's answers, who may be asked for them, and refusals.

All calls but those for events, history and the arm's shape are made on the service's event loop (asyncio, the same
thread); no answer waits for bus or disk.
"""

import asyncio
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from pydantic import AwareDatetime, BaseModel, BeforeValidator, ConfigDict, Field

from gcomp.arrays import Array


class State(StrEnum):
    """Activity of the daemon."""

    STARTING = "starting"
    OBSERVING = "observing"
    SWEEPING = "sweeping"
    RECALIBRATING = "recalibrating"
    FAULT = "fault"


Policy = Literal["observe", "propose", "apply"]
"""Treatment of a drift: an event only, a proposal, or a new record written to the controller."""
ProposalState = Literal["pending", "approved", "applied", "rejected", "failed", "superseded"]


Vector = tuple[float, float, float]
Number = Annotated[float | None, BeforeValidator(lambda value: value if value is None or isfinite(value) else None)]
"""None for NaN and infinities, which JSON does not have."""


class Answer(BaseModel):
    """Base of every answer."""

    model_config = ConfigDict(frozen=True)


class BusHealth(Answer):
    """Counters of the bus loop since the bus was last opened."""

    connected: bool
    """Whether frames of the joints are arriving."""
    fault: str | None = None
    """Why not, in one line."""
    rate_hz: float = 0.0
    """Cycles (SYNC) per second."""
    load: float = 0.0
    """Bus load as a share of its capacity."""
    frames: int = 0
    missed: int = 0
    """Sensor frames that did not arrive in their cycle."""
    late: int = 0
    """Own cycles that began more than a tenth of a period late."""
    errors: int = 0


class RecordsInForce(Answer):
    """Ids of the records in force; None if there is none."""

    calibration: str | None = None
    gravity: str | None = None


class Status(Answer):
    """GET /api/status."""

    state: State
    detail: str = ""
    """Reason for this state, in one line; may be empty."""
    arm: str
    serial: str
    version: str
    policy: Policy
    listen_only: bool
    time: AwareDatetime
    t: float
    uptime_s: float
    bus: BusHealth
    records: RecordsInForce
    uncalibrated: tuple[str, ...] = ()
    """Joints whose calibration is kept in the host and that have no record in force: their torque is what the drive
    takes it for."""
    held: bool = False
    """Whether an alarm is open, so that estimates are held until its cause is known."""
    rows: int = 0
    """Rests of the arm that the observer has used since the daemon first ran with these records."""
    pending_proposals: int = 0
    last_event: int = 0
    """Id of the newest event; 0 if there is none."""
    store_fault: str | None = None
    """Why the record store cannot be read, in one line; the records in force are kept."""
    journal_fault: str | None = None
    """Why the journal cannot be written, in one line; events wait until it can."""
    report: Path | None = None
    """The newest report (HTML) of a sweep, if there is one."""


class JointNow(Answer):
    """One joint of GET /api/joints, and of the stream."""

    joint: str
    position: Number
    """[rad]"""
    torque: Number
    """Sensor as the controller calibrates it [N·m]."""
    model_torque: Number
    """Gravity model at this position [N·m]."""
    residual: Number
    """Torque minus model torque [N·m]; meaningful at rest."""
    temperature: Number = None
    """Of the drive [°C]; None if it does not tell it."""
    state: str
    """State of the drive in words; "unknown" before its first reading."""
    sample_age_s: Number
    """Time since position and torque last arrived; None if they never did."""
    external_torque: Number = None
    """With which the surroundings push this joint [N·m]; None where GET /api/external says why not."""
    external_bound: Number = None
    """Half width of its 95 % interval [N·m]."""


class JointEstimate(Answer):
    """One joint of GET /api/estimates, against the installed record: gain 1 and offset 0 mean no change."""

    joint: str
    gain: float
    gain_std: float
    offset: float
    """[N·m]"""
    offset_std: float
    samples: int
    """Rests of the arm used for the estimate."""
    last_accepted: AwareDatetime | None
    installed_gain: Number
    """Gain and offset [N·m] of the record in force."""
    installed_offset: Number
    gain_limit: Number = None
    """Smallest change of gain that would be noticed now, relative; None if gravity does not load the joint."""
    offset_limit: Number = None
    """Smallest change of offset that would be noticed now [N·m]."""
    limit_rests: int | None = None
    """Rests at other poses after which changes of this size are noticed; larger ones are sooner."""


class ExternalWrench(Answer):
    """Force and moment at a point of a link, in the axes of the base; None along axes that the joints do not show."""

    joint: str
    """With whose frame the point turns."""
    point: Vector
    """In that frame [m]."""
    force: tuple[Number, Number, Number]
    """[N]"""
    force_std: tuple[Number, Number, Number]
    moment: tuple[Number, Number, Number]
    """[N·m]"""
    moment_std: tuple[Number, Number, Number]


class ExternalEvent(Answer):
    """A contact, or a load that was taken up or put down."""

    time: AwareDatetime
    """When it was decided."""
    kind: str
    """contact, load, load put down, contact or load."""
    joints: tuple[str, ...]
    """Those whose torque it changes beyond their bound, the surest first."""
    link: str
    """Joint that turns the likeliest link."""
    probability: Number
    """Of that link, given a contact."""
    least_force: Number
    """95 % lower bound of the force of a contact [N]."""
    mass: Number
    """Of a load [kg]; negative if put down."""


class ExternalNow(Answer):
    """GET /api/external: torque that neither arm nor tool nor friction explains."""

    reason: str
    """Why there is none, in one line; empty if there is."""
    age_s: Number = None
    """Time since the newest row; None before the first."""
    baseline_s: Number = None
    """Work without contact that the bounds rest on [s]."""
    false_alarms_per_hour: Number = None
    torque: tuple[Number, ...] = ()
    """With which the surroundings push the joints, base to tip [N·m]."""
    bound: tuple[Number, ...] = ()
    """Half widths of the 95 % intervals [N·m]."""
    wrench: ExternalWrench | None = None
    load: Number = None
    """Mass that the arm was found to have taken up [kg]."""
    events: tuple[ExternalEvent, ...] = ()
    """The newest ones, oldest first."""
    counts: dict[str, int] = {}
    """Number of events of each kind since the daemon started."""


class EventRecord(Answer):
    """One line of the event log."""

    id: int
    time: AwareDatetime
    t: float
    kind: str
    """drift, payload, contact, effect, alarm, clear, undecided, proposal, approved, rejected, recalibration, refused,
    roll-back, sweep, fault, recovered, started, stopped, configuration, clock, diagnosis, wear."""
    joint: str | None
    text: str
    """One line, for people."""
    evidence: dict[str, Any]


class HistoryPoint(Answer):
    """Estimate of one joint at one time, as JointEstimate has it."""

    time: AwareDatetime
    t: float
    joint: str
    gain: float
    gain_std: float
    offset: float
    offset_std: float
    record: str | None
    """Calibration record in force at that time; gain and offset are relative to it."""


class Proposal(Answer):
    """One proposed recalibration."""

    id: int
    """The number of its record, 32 bits of the SHA-256 of what would be written: it never names another proposal."""
    hash: str = ""
    """SHA-256 (hex) of what is decided, evidence included; an approval or rejection may name it."""
    time: AwareDatetime
    state: ProposalState
    joint: str
    cause: str
    """gain, offset or drift (both)."""
    gain: float
    """Relative to what is installed."""
    gain_std: float
    offset: float
    """[N·m]"""
    offset_std: float
    rows: int
    confidence: float
    record: str
    """Id of the record that approval makes current."""
    base: str
    """Id of the record that it replaces."""
    decided_at: AwareDatetime | None = None
    decided_by: str | None = None
    note: str = ""
    """Why it failed or was superseded."""


class DrawnJoint(Answer):
    """One joint of GET /api/arm, in the arm's base frame with every joint at its `reference`."""

    joint: str
    axis: Vector
    """Unit vector."""
    point: Vector
    """On the axis [m]."""
    reference: float
    """Joint position [rad]."""
    link: tuple[Vector, ...]
    """Corners of a line from this joint to the next, the last one to the tip [m]."""


class DrawnArm(Answer):
    """GET /api/arm: what is needed to draw the arm at any joint positions."""

    up: Vector
    """Unit vector against gravity."""
    joints: tuple[DrawnJoint, ...]
    """Base to tip. A joint turns all that follows it about its axis by its position less `reference`."""


class WindowRows(Answer):
    """GET /api/window: K readings of every joint, oldest first; a missing number is null."""

    time: AwareDatetime
    """Of the newest one."""
    joints: tuple[str, ...]
    t: tuple[float, ...]
    """Time since the oldest one (K) [s]."""
    position: tuple[tuple[float | None, ...], ...]
    """[rad], K rows with a value per joint, as all that follow."""
    torque: tuple[tuple[float | None, ...], ...]
    """Sensor as the controller calibrates it [N·m]."""
    model_torque: tuple[tuple[float | None, ...], ...]
    """Gravity model at these positions [N·m]."""
    temperature: tuple[tuple[float | None, ...], ...]
    """Of the drives [°C]."""


class Overview(Answer):
    """GET /api/overview: everything that the page shows, in one answer."""

    status: Status
    joints: tuple[JointNow, ...]
    estimates: tuple[JointEstimate, ...]
    external: ExternalNow
    proposals: tuple[Proposal, ...]
    events: tuple[EventRecord, ...]
    """The newest, oldest first."""
    history: tuple[HistoryPoint, ...]


class JointsItem(Answer):
    """Item of the stream, ten times per second."""

    type: Literal["joints"] = "joints"
    time: AwareDatetime
    t: float
    state: State
    bus: BusHealth
    joints: tuple[JointNow, ...]
    wrench: ExternalWrench | None = None
    """As GET /api/external has it."""
    load: Number = None
    """Likewise [kg]."""


class ContactItem(Answer):
    """Item of the stream, one per contact and load: at once, while the event log has but one of a kind a minute."""

    type: Literal["contact"] = "contact"
    contact: ExternalEvent


class EventItem(Answer):
    """Item of the stream, one per event."""

    type: Literal["event"] = "event"
    event: EventRecord


StreamItem = Annotated[JointsItem | ContactItem | EventItem, Field(discriminator="type")]


@dataclass(frozen=True, eq=False)
class Window:
    """K rows of n joints, oldest first."""

    names: tuple[str, ...]
    time: datetime
    """Of the newest row."""
    t: Array
    """Time since the oldest row (K,) [s]."""
    channels: dict[str, Array]
    """`position` [rad], `torque` and `model_torque` [N·m], `temperature` [°C] → (K, n); NaN if missing."""


class NotPossible(Exception):
    """An approval or rejection that is not possible now; the message says why (HTTP 409)."""


class NoSuch(Exception):
    """No proposal or joint of that id or name (HTTP 404)."""


class NotYet(Exception):
    """A decision that is taken, but not on disk yet; the message says so (HTTP 503)."""


class Client(asyncio.Queue[StreamItem]):
    """One client's items: those of five seconds of joints; used on the event loop's thread only.

    A client that is too slow loses the oldest ones and never delays the daemon.
    """

    def __init__(self, hub: "Hub") -> None:
        super().__init__(maxsize=50)
        self._hub = hub

    def add(self, item: StreamItem) -> None:
        if self.full():
            self.get_nowait()
        self.put_nowait(item)

    def close(self) -> None:
        self._hub.clients.discard(self)


class Hub:
    def __init__(self) -> None:
        self.clients: set[Client] = set()

    def subscribe(self) -> Client:
        client = Client(self)
        self.clients.add(client)
        return client

    def publish(self, item: StreamItem) -> None:
        for client in self.clients:
            client.add(item)


class DaemonView(Protocol):
    """Everything that the web layer can reach. Nothing here commands torque or motion."""

    def approve(self, number: int, by: str, digest: str | None = None) -> Future[Proposal]:
        """Write a pending proposal and make its record current; `digest` is the `hash` of what was looked at.

        It is `approved` once that is on disk, which is when the answer is there, and `applied` or `failed` a moment
        later (an event). The decision stands even if nobody waits for the answer. Raises NoSuch, NotPossible.
        """

    def reject(self, number: int, by: str, digest: str | None = None) -> Future[Proposal]:
        """Drop a pending proposal; likewise."""

    def status(self) -> Status: ...

    def joints(self) -> tuple[JointNow, ...]:
        """Every joint as of the newest snapshot, base to tip."""

    def external(self) -> ExternalNow:
        """External torque as of the newest row."""

    def window(self, seconds: float, most: int) -> Window:
        """Readings of the last `seconds` (at most 600), thinned evenly to at most `most` rows."""

    def arm(self) -> DrawnArm:
        """The arm's shape, from its model; raises NoSuch if that cannot be read. May be called in any thread."""

    def estimates(self) -> tuple[JointEstimate, ...]:
        """Every joint's gain and offset, base to tip; empty while there is no gravity record."""

    def events(self, after: int = 0, limit: int = 500) -> tuple[EventRecord, ...]:
        """At most `limit` events with an id above `after`, oldest first; ask again after the last id for more.

        May be called in any thread.
        """

    def history_pages(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> Iterator[tuple[HistoryPoint, ...]]:
        """Estimates over time, oldest first, in pieces that fit in memory; raises NoSuch at the first.

        Thinned evenly to at most `most` per joint; without a joint those of every joint, one after the other. From any
        thread.
        """

    def proposals(self, limit: int = 200) -> tuple[Proposal, ...]: ...

    def subscribe(self) -> Client:
        """A new client of the stream, which begins with the present joints."""
