"""The daemon's service on the fast arm: batches at 50 Hz, no bus, controllers that are a table; for long times."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from fast_arm import PERIOD, FastArm
from same_thread import Immediate

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import BusFault
from armlink.link.types import Calibration, Controller, DriveSerial, Stats
from armlink.loop.messages import Batch, Progress, Up
from calib.daemon.environment import Environment
from calib.daemon.service import Service
from calib.daemon.service_view import ServiceView
from calib.daemon.settings import DaemonSection
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore

START = datetime(2026, 1, 1, tzinfo=UTC)
QUIET = {"enabled": False}


def slow(arm: ArmFile) -> ArmFile:
    """The same arm at the rate of the fast arm's samples, so that the service takes them as they are."""
    return arm.model_copy(update={"link": arm.require_link().model_copy(update={"rate": 1 / PERIOD})})


def settings(policy: str, **more: object) -> DaemonSection:
    """Of a daemon that records nothing."""
    return DaemonSection.model_validate({"policy": policy, "recording": QUIET, **more})


class HeldDisk(Immediate):
    """A disk that answers at once or, while it is `held`, not at all."""

    def __init__(self) -> None:
        self.held = False
        self.waiting: list[tuple[Callable[[], Any], Callable[[Any], None]]] = []

    def __call__(self, work: Callable[[], Any], done: Callable[[Any], None]) -> None:
        if self.held:
            self.waiting.append((work, done))
        else:
            super().__call__(work, done)

    def release(self) -> None:
        """It answers again."""
        self.held = False
        waiting, self.waiting = self.waiting, []
        for work, done in waiting:
            super().__call__(work, done)

    def drain(self, seconds: float, /) -> bool:
        """Held, it does not come to an end."""
        return not self.waiting


class FastDaemon:
    """`run(seconds)`; the arm is `fast`, the daemon's answers are `view`."""

    def __init__(
        self,
        directory: Path,
        seed: int = 0,
        settings: DaemonSection | None = None,
        arm: str = "sarcos",
        listen_only: bool = False,
        records: bool = True,
        store: str | None = None,
    ) -> None:
        self.arm = slow(load_arm(arm))
        self.fast = FastArm(self.arm, seed)
        self.directory, self.listen_only = directory, listen_only
        self.settings = settings or DaemonSection(policy="apply", recording=QUIET)
        self.wall_shift, self.clock_shift = timedelta(), 0.0
        self.store = RecordStore(store or str(directory / "records.db"))
        self.controllers, self.port = self, self
        self.ids, self.dates = [0] * self.fast.n, [0] * self.fast.n
        self.drives = [f"1:1:{k}" for k in range(self.fast.n)]
        self.sdo: list[str] = []
        self.run_aside = Immediate()
        self.disk = HeldDisk()
        self.on_write: Callable[[int], None] = lambda joint: None
        self.touring, self.job_after = 0, self.fast.job
        if records:
            for record in self.good_records():
                self.store.put(record, self.arm, by="ann", reason="sweep")
        self.start()

    def good_records(self) -> tuple[CalibrationRecord, GravityRecord]:
        fast, names = self.fast, self.arm.joint_names
        joints = tuple(
            JointCalibration(name=name, gain=1.0, offset=0.0, position_gain=1.0, position_offset=0.0) for name in names
        )
        gravity = GravityRecord(
            **provenance(self.arm, created=START),
            names=names,
            beta=tuple(fast.model.tolist()),
            covariance=matrix(fast.covariance),
            identifiable=(True,) * fast.model.size,
            gravity=self.arm.kinematics.gravity,
        )
        return CalibrationRecord(**provenance(self.arm, created=START), joints=joints), gravity

    def start(self, up: bool = True) -> None:
        environment = Environment(
            self.now, self.wall, lambda work, done: self.run_aside(work, done), self, self.disk, Immediate()
        )
        state = self.directory / "state"
        self.service = Service(self.arm, self.settings, self.listen_only, state, self.store, environment)
        self.view = ServiceView(self.service)
        if up:
            self.service.take(Up(None if self.listen_only else self.held()))

    def held(self) -> tuple[Calibration, ...]:
        columns = self.fast.held_gain.tolist(), self.fast.held_offset.tolist(), self.ids, self.dates
        return tuple(Calibration(*each) for each in zip(*columns, strict=True))

    def now(self) -> float:
        return self.fast.t + self.clock_shift

    def wall(self) -> datetime:
        return START + timedelta(seconds=self.fast.t) + self.wall_shift

    # ---- what the service asks of the bus loop

    def drive_serial(self, joint: int) -> DriveSerial:
        return DriveSerial(self.drives[joint])

    def read_calibration(self, joint: int) -> Calibration:
        self.sdo.append(f"read {joint}")
        gain, offset = float(self.fast.held_gain[joint]), float(self.fast.held_offset[joint])
        return Calibration(gain, offset, self.ids[joint], self.dates[joint])

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        self.sdo.append(f"write {joint}")
        self.on_write(joint)
        self.fast.held_gain[joint] = np.float32(calibration.gain)
        self.fast.held_offset[joint] = np.float32(calibration.offset)
        self.ids[joint], self.dates[joint] = calibration.record_id, calibration.date
        return self.read_calibration(joint)

    def move(self, controller: Controller) -> None:
        self.tour(len(controller.tour))

    def tour(self, poses: int) -> None:
        self.touring, self.job_after, self.fast.job = poses, self.fast.job, None

    # ---- time

    def drift(self) -> None:
        """The torque sensor of joint 3 drifts by 3 % and 0.3 N·m."""
        self.fast.gain[2] *= 1.03
        self.fast.offset[2] += 0.3

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let the arm work for so long, or less."""
        ticked = self.fast.t
        for t, position, torque in self.fast.samples(seconds):
            self.service.take(self.batch(t + self.clock_shift, position, torque))
            if self.touring:
                self.touring -= 1
                if not self.touring:
                    self.fast.job = self.job_after
                self.service.take(Progress(60 - self.touring, 60))
            if self.fast.t - ticked >= 1.0:
                ticked = self.fast.t
                self.service.tick()
            if until():
                break

    def batch(self, t: np.ndarray, position: np.ndarray, torque: np.ndarray) -> Batch:
        nothing = np.full_like(position, np.nan)
        channels = {"position": position, "torque": torque, "torque_command": torque, "position_command": position}
        channels |= {"velocity": nothing, "motor_torque": torque}
        status = np.full(self.fast.n, 0x27)
        return Batch(t, channels, status, np.zeros(self.fast.n), Stats(frames=1, rate_hz=250.0))

    def kill(self) -> None:
        """As SIGKILL does."""
        self.service.journal.close()

    def of_kind(self, *kinds: str) -> list[Any]:
        return [event for event in self.view.events(limit=100_000) if event.kind in kinds]

    def broken(self, joint: int) -> None:
        """For on_write: the bus fails."""
        raise BusFault("joint gone")


def drifted(folder: Path) -> FastDaemon:
    """Joint 3 has drifted, and its recalibration waits for an approval."""
    daemon = FastDaemon(folder, 1, settings("propose"))
    daemon.run(40)
    daemon.drift()
    daemon.run(80)
    return daemon


def metric(daemon: FastDaemon, name: str) -> str:
    """A value of GET /metrics."""
    from calib.daemon.web.metrics import metrics_text
    from calib.daemon.web.stream import Streams

    text = metrics_text(daemon.view, Streams(daemon.view))().decode()
    return next(line.split()[1] for line in text.splitlines() if line.startswith(f"armlink_{name} "))
