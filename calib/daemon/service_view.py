"""The service as the web layer sees it: implements `calib.daemon.view.DaemonView`."""

import math
from collections.abc import Iterator
from datetime import datetime, timedelta
from importlib.metadata import version
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.errors import BadInput
from armlink.link.joints.groups import state_name
from calib.arm.kinematics import frame_origins, gcomp_arm, model_arm, model_chain
from calib.daemon import view
from calib.daemon.observation.observation import ObserverFeed
from calib.daemon.service import Service
from calib.daemon.state.arm_state import LONGEST_PAUSE
from calib.daemon.state.journal_rows import HistoryReader
from calib.daemon.view import Client, DrawnArm, DrawnJoint, NoSuch, Window
from calib.external.listening import LiveExternal
from calib.external.tables import wrench_of
from gcomp.arm.arm import Arm, bar_rotations
from gcomp.arm.load import PlacedChain
from gcomp.arrays import Array
from gcomp.external.external_model import NORMAL_95


class ServiceView:
    """Answers from the service's parts; see `DaemonView`."""

    def __init__(self, service: Service) -> None:
        self._service, self._version = service, version("armlink")
        self._history = HistoryReader(service.journal.path)
        self._arm: view.DrawnArm | None = None
        self.approve, self.reject = service.recalibrations.approve, service.recalibrations.reject

    @property
    def _feed(self) -> ObserverFeed | None:
        return self._service.records.feed

    def status(self) -> view.Status:
        service, feed = self._service, self._feed
        arm_state, configuration, now = service.arm_state, service.configuration, service.environment.monotonic()
        return view.Status(
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
            records=view.RecordsInForce(
                calibration=None if feed is None else feed.calibration.id,
                gravity=None if feed is None else feed.gravity.id,
            ),
            uncalibrated=arm_state.uncalibrated,
            held=feed is not None and feed.observer.held,
            rows=0 if feed is None else feed.observer.rows,
            pending_proposals=service.journal.pending(),
            store_fault=service.records.store_fault or None,
            journal_fault=service.journal.trouble or None,
            last_event=service.journal.last_event,
            report=service.report,
        )

    def joints(self) -> tuple[view.JointNow, ...]:
        arm, arm_state = self._service.configuration.arm, self._service.arm_state
        batch, names = arm_state.batch, arm.joint_names
        position = torque = temperature = ages = np.full(len(names), math.nan)
        states = ["unknown"] * len(names)
        if batch is not None:
            position, torque = batch.channels["position"][-1], batch.channels["torque"][-1]
            temperature = temperature if batch.temperature is None else batch.temperature
            states = [state_name(arm, joint, code) for joint, code in enumerate(batch.status.tolist())]
            ages = batch.age + arm_state.late
        (torque,), (model,) = self._torques(position[None], torque[None])
        external, bound = self._external()
        columns = zip(
            names, position, torque, model, torque - model, temperature, states, ages, external, bound, strict=True
        )
        return tuple(view.JointNow(**dict(zip(view.JointNow.model_fields, column, strict=True))) for column in columns)

    @property
    def _live(self) -> LiveExternal | None:
        """External torque of now; None without, or where its newest row is old."""
        live = self._service.external.live
        return None if live is None or live.row is None or self._age(live.row.t) > LONGEST_PAUSE else live

    def _external(self) -> tuple[Array, Array]:
        """External torque and its 95 % bound (n,) [N·m]; NaN without."""
        live = self._live
        if live is None or live.row is None:
            unknown = np.full(len(self._service.configuration.names), math.nan)
            return unknown, unknown
        return live.row.external, NORMAL_95 * live.row.std

    def _age(self, t: float) -> float:
        return max(self._service.environment.monotonic() - t, 0.0)

    def external(self) -> view.ExternalNow:
        part = self._service.external
        told = view.ExternalNow(reason=part.reason, events=tuple(part.events), counts=part.counts)
        if part.live is None:
            return told
        torque, bound = self._external()
        row, learned = part.live.row, part.live.learned
        now = {
            "reason": "" if row is not None else "no row of samples has come yet",
            "age_s": None if row is None else self._age(row.t),
            "baseline_s": learned.listener.model.seconds,
            "false_alarms_per_hour": learned.per_hour,
            "torque": tuple(torque.tolist()),
            "bound": tuple(bound.tolist()),
            "wrench": self._wrench(part.live),
            "load": part.live.load,
        }
        return view.ExternalNow.model_validate(dict(told) | now)

    def _wrench(self, live: LiveExternal | None) -> view.ExternalWrench | None:
        told = None if live is None else live.wrench()
        if live is None or told is None:
            return None
        frame = live.learned.frame
        place = {"joint": self._service.configuration.names[frame.link], "point": tuple(frame.point.tolist())}
        return view.ExternalWrench.model_validate(place | wrench_of(told))

    def window(self, seconds: float, most: int) -> Window:
        """Readings of the last `seconds`, thinned evenly to at most `most` rows; the model's torque is today's."""
        environment = self._service.environment
        t, channels = self._service.window.rows(seconds, most)
        torque, model = self._torques(channels["position"], channels["torque"])
        late = timedelta(seconds=environment.monotonic() - float(t[-1])) if len(t) else timedelta()
        channels |= {"torque": torque, "model_torque": model}
        return Window(self._service.configuration.names, environment.wall() - late, t - t[:1], channels)

    def arm(self) -> view.DrawnArm:
        """The arm's shape; read from its model on the first call. Raises NoSuch."""
        if self._arm is None:
            try:
                self._arm = drawn_arm(self._service.configuration.arm)
            except (BadInput, OSError) as error:
                raise NoSuch(f"the arm cannot be drawn: {error}") from None
        return self._arm

    def _torques(self, position: Array, torque: Array) -> tuple[Array, Array]:
        """Torques (K, n) as sent, converted to the record in force, and the model's at these positions; NaN without."""
        model = np.full(position.shape, math.nan)
        if self._feed is not None:
            torque = self._feed.reading(torque)
            known = np.isfinite(position).all(axis=1)
            if known.any():
                model[known] = self._feed.observer.model_torque(position[known])
        return torque, model

    def estimates(self) -> tuple[view.JointEstimate, ...]:
        feed = self._feed
        if feed is None:
            return ()
        estimate, limits = feed.observer.estimate(), feed.observer.limits()
        gain, offset = (feed.calibration.values(name) for name in ("gain", "offset"))
        return tuple(
            view.JointEstimate(
                joint=name,
                gain=estimate.gain[j],
                gain_std=estimate.gain_std[j],
                offset=estimate.offset[j],
                offset_std=estimate.offset_std[j],
                samples=estimate.accepted[j],
                last_accepted=feed.last_accepted.get(name),
                installed_gain=gain[j],
                installed_offset=offset[j],
                gain_limit=limits.gain[j],
                offset_limit=limits.offset[j],
                limit_rests=limits.rests,
            )
            for j, name in enumerate(feed.names)
        )

    def events(self, after: int = 0, limit: int = 500) -> tuple[view.EventRecord, ...]:
        return tuple(self._service.journal.events(after, limit))

    def history_pages(
        self, joint: str | None, since: datetime | None = None, until: datetime | None = None, most: int = 2000
    ) -> Iterator[tuple[view.HistoryPoint, ...]]:
        names, reader = self._service.configuration.names, self._history
        if joint is not None and joint not in names:
            raise NoSuch(f"there is no joint {joint!r}; expected one of {', '.join(names)}")
        chosen = reader.chosen(since, until, most)
        for j in range(len(names)) if joint is None else (names.index(joint),):
            for page in reader.pages(chosen):
                points = (_point(names[j], j, *row) for row in page)
                yield tuple(point for point in points if point is not None)

    def proposals(self, limit: int = 200) -> tuple[view.Proposal, ...]:
        return tuple(row.proposal for row in self._service.journal.proposals(limit))

    def subscribe(self) -> Client:
        client = self._service.hub.subscribe()
        client.add(self.snapshot())
        return client

    def snapshot(self) -> view.JointsItem:
        """The present joints as an item of the stream."""
        environment, live = self._service.environment, self._live
        return view.JointsItem(
            time=environment.wall(),
            t=environment.monotonic(),
            state=self._service.state,
            bus=self._bus(),
            joints=self.joints(),
            wrench=self._wrench(live),
            load=None if live is None else live.load,
        )

    def publish(self) -> None:
        """Give the stream its item: ten times a second, bus or no bus."""
        if self._service.hub.clients:
            self._service.hub.publish(self.snapshot())

    def _bus(self) -> view.BusHealth:
        arm_state = self._service.arm_state
        counted: dict[str, Any] = {}
        if arm_state.batch is not None:
            names = ("rate_hz", "load", "frames", "missed", "late", "errors")
            counted = {name: getattr(arm_state.batch.stats, name) for name in names}
            if not arm_state.connected:
                counted |= {"rate_hz": 0.0, "load": 0.0}
        fault = arm_state.fault or arm_state.silent or None
        return view.BusHealth(connected=bool(arm_state.connected), fault=fault, **counted)


def _point(
    joint: str, j: int, time: datetime, t: float, record: str | None, estimate: dict[str, list[float]]
) -> view.HistoryPoint | None:
    """None for a row of fewer joints, or a damaged one."""
    try:
        values = {name: estimate[name][j] for name in ("gain", "gain_std", "offset", "offset_std")}
        return view.HistoryPoint(time=time, t=t, joint=joint, record=record, **values)
    except (LookupError, TypeError, ValueError):
        return None


def drawn_arm(arm_file: ArmFile) -> DrawnArm:
    """The arm of an arm file, in the base frame, or its model's world frame; raises BadInput or OSError.

    At joint positions q, link i stands where the rotations by q_j − reference_j about axes j ≤ i bring it, the last
    one first.
    """
    if arm_file.model_path is None:
        arm = gcomp_arm(arm_file)
        gravity, reference, (axes, links) = arm.gravity, np.zeros(arm.n), _of_rows(arm)
    else:
        placed = model_chain(arm_file)
        arm = model_arm(arm_file, placed).arm  # which also says what is wrong with a model file
        gravity, reference, (axes, links) = placed.model.opt.gravity, placed.reference, _of_model(placed)
    if len(links[-1]) < 2:  # a last link without length gets a stub of 8 cm
        links[-1] = np.stack([links[-1][0], links[-1][0] + 0.08 * axes[-1]])
    size = float(np.linalg.norm(gravity))
    up = -gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
    joints = [
        {"joint": name, "axis": axis.tolist(), "point": link[0].tolist(), "reference": zero, "link": link.tolist()}
        for name, axis, zero, link in zip(arm.names, axes, reference, links, strict=True)
    ]
    return DrawnArm(up=up.tolist(), joints=tuple(map(DrawnJoint.model_validate, joints)))


def _of_rows(arm: Arm) -> tuple[Array, list[Array]]:
    """Axes and links of Denavit-Hartenberg rows: a link leads along its joint's axis by d, then along x by a."""
    zero = np.zeros((1, arm.n))
    axes, origins = bar_rotations(arm, zero)[0, :, :, 2], frame_origins(arm, zero)[0]
    feet = origins[:-1] + arm.d[:, None] * axes
    return axes, [_corners(*each) for each in zip(origins[:-1], feet, origins[1:], strict=True)]


def _of_model(placed: PlacedChain) -> tuple[Array, list[Array]]:
    """Axes and links: straight from joint to joint, the last link to the body of it that is farthest away."""
    anchors, ends = placed.anchors, [placed.data.xpos[body] for body in placed.bodies[-1]]
    tip = max(ends, key=lambda end: float(np.linalg.norm(end - anchors[-1])))
    links = [_corners(start, end) for start, end in zip(anchors, [*anchors[1:], tip], strict=True)]
    return placed.geometry.bar[:, :, 2], links


def _corners(*points: Array) -> Array:
    """The points without those that repeat the one before."""
    kept = [points[0]]
    for point in points[1:]:
        if np.linalg.norm(point - kept[-1]) > 1e-6:
            kept.append(point)
    return np.array(kept)
