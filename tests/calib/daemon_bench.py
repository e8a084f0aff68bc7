"""A whole daemon on an in-process simulated arm, in lock-step: service, bus loop, journal and view, no process."""

import math
import pickle
import socket
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from same_thread import Immediate

from armlink.arm_file import ArmFile, load_arm
from armlink.bus.can_bus import CanBus
from armlink.channel import Channel
from armlink.link.ends import EndCause
from armlink.link.types import Controller
from armlink.loop.cycle_process import RemoteControllers
from armlink.loop.kept_arm import BatchMaker, KeptMessage
from armlink.loop.messages import Open, RunController
from calib.arm.kinematics import gcomp_arm
from calib.daemon.environment import Environment
from calib.daemon.service import Service
from calib.daemon.service_view import ServiceView
from calib.daemon.settings import DaemonSection
from calib.install.journaled_write import install
from calib.install.plausibility import admit
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore
from gcomp.arm.mass_moments import base_parameters
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

START = datetime(2026, 1, 1, tzinfo=UTC)


def good_records(arm: ArmFile, truth: Truth) -> tuple[CalibrationRecord, GravityRecord]:
    """What a good sweep would have found on this simulated arm."""
    columns = zip(arm.joint_names, truth.gain, truth.offset, truth.position_gain, truth.position_offset, strict=True)
    joints = tuple(
        JointCalibration(name=name, gain=g, offset=o, position_gain=p, position_offset=z)
        for name, g, o, p, z in columns
    )
    described, links = gcomp_arm(arm), arm.sim.links
    mass = np.array([link.mass for link in links])
    beta = base_parameters(described, mass, mass[:, None] * np.array([link.com for link in links]))
    std = 1e-3 * np.abs(beta).max() * np.linspace(1.0, 0.2, beta.size)
    gravity = GravityRecord(
        **provenance(arm, created=START),
        names=arm.joint_names,
        beta=tuple((beta + std * np.random.default_rng(5).normal(size=beta.size)).tolist()),
        covariance=matrix(np.diag(std**2)),
        identifiable=(True,) * beta.size,
        gravity=arm.kinematics.gravity,
    )
    return CalibrationRecord(**provenance(arm, created=START), joints=joints), gravity


class InlineLoop:
    """The kept loop in this thread: `pump` runs the cycles of a tenth of a second."""

    def __init__(self, arm: ArmFile, open_bus: Callable[[], CanBus], listen_only: bool = False, pace: bool = False):
        from armlink.loop.process import KeptLoop  # not loaded where only the records are wanted

        ours, theirs = socket.socketpair()
        for end in (ours, theirs):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        self.channel, self.batches = Channel(ours), BatchMaker()
        self.loop = KeptLoop(Channel(theirs), Open(arm, None, True, listen_only), open_bus, pace)
        self.controllers = RemoteControllers(self.loop._answer)
        self.cycles = 1 if listen_only else round(0.1 * arm.require_link().rate)
        if not pace:
            self.loop._talked, self.loop.talk_every = time.monotonic(), math.inf

    def move(self, controller: Controller) -> None:
        """Run a controller from the next cycle on."""
        self.loop._handle(RunController(1, pickle.dumps(controller)))
        if self.loop._unpickled is not None:
            self.loop._unpickled.result()

    def pump(self) -> list[KeptMessage]:
        """Run cycles; returns their messages."""
        for _ in range(self.cycles):
            there = self.loop.arm is not None
            self.loop.turn()
            if not there or self.loop.arm is None:
                break
        if self.cycles > 1:
            self.loop._talk()
        return [made for message in self.channel.receive() if (made := self.batches.take(message)) is not None]

    def close(self) -> None:
        """Leave the joints safe."""
        self.loop.close(EndCause.DONE)


class DaemonBench:
    """`run(seconds)` of simulated time; `kill()` and `start()` as a crash and a restart would."""

    def __init__(
        self,
        directory: Path,
        arm: str | ArmFile = "sarcos",
        seed: int = 1,
        settings: DaemonSection | None = None,
        records: bool = True,
        work: bool = True,
    ) -> None:
        self.arm = load_arm(arm) if isinstance(arm, str) else arm
        self.directory, self.seed, self.work = directory, seed, work
        self.settings = settings or DaemonSection(recording={"enabled": False})
        truth = Truth.draw(self.arm, seed)
        self.simulated = SimulatedArm(self.arm, truth, seed)
        self.truth = truth
        self.wall_shift = timedelta()
        self.store = RecordStore(str(directory / "records.db"))
        if records:
            calibration, gravity = good_records(self.arm, self.simulated.true_sensors)
            self.store.put(calibration, self.arm, by="ann", reason="sweep")
            self.store.put(gravity, self.arm, by="ann", reason="sweep")
        self.bus_there = True
        self.start()
        if records:
            self.install()

    def start(self) -> None:
        """A service as the command starts it, on what the directory holds."""
        self.host = InlineLoop(self.arm, self._open)
        environment = Environment(self.now, self.wall, Immediate(), self.host, Immediate(), Immediate())
        settings = self.settings.model_copy(update={"work": self.work})
        self.service = Service(self.arm, settings, False, self.directory / "state", self.store, environment)
        self.view = ServiceView(self.service)

    def _open(self) -> LockStepBus:
        from armlink.errors import BusFault

        if not self.bus_there:
            raise BusFault("bus socketcan:can9: cannot open it: No such device")
        return LockStepBus(arm=self.simulated)

    def install(self) -> None:
        """Write the current record to the controllers, as `armlink calibrate --apply` does."""
        record = self.store.current(CalibrationRecord, self.arm)
        assert record is not None
        for message in self.host.pump():
            self.service.take(message)
        admitted = admit(record, self.arm, self.store)
        install(admitted, self.store, self.host.controllers, by="ann", reason="sweep", check=None)
        self.service.records.held(None)

    def now(self) -> float:
        return self.simulated.time

    def wall(self) -> datetime:
        return START + timedelta(seconds=self.simulated.time) + self.wall_shift

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let so much simulated time pass, or less."""
        end = self.now() + seconds
        ticked = self.now()
        while self.now() < end and not until():
            for message in self.host.pump():
                self.service.take(message)
            if self.host.loop.arm is None:
                self.simulated.advance(0.1)
            self.view.publish()
            if self.now() - ticked >= 1.0:
                self.service.tick()
                ticked = self.now()

    def kill(self) -> None:
        """As SIGKILL does: nothing is closed, saved or said."""
        self.service.journal.close()
        self.host.loop.arm = None

    def kinds(self) -> list[str]:
        return [event.kind for event in self.view.events()]

    def of_kind(self, kind: str) -> list[Any]:
        return [event for event in self.view.events(limit=10_000) if event.kind == kind]
