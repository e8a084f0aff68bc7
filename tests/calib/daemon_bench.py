"""A whole daemon on an in-process simulated arm, in lock-step: service, bus loop, journal and view, no process."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile, load_arm
from armlink.loop.messages import LoopAnswer
from calib.arm.kinematics import gcomp_arm
from calib.daemon.environment import Environment
from calib.daemon.loop.loop_messages import LoopOptions, Message
from calib.daemon.loop.loop_process import LoopControllers, _tour
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


def run_now(work: Callable[[], Any], done: Callable[[Any], None]) -> None:
    """A job at once, in this thread."""
    try:
        outcome: Any = work()
    except Exception as error:
        outcome = error
    done(outcome)


class InlineLoop:
    """The loop in this thread: `pump` runs the cycles of a tenth of a second."""

    def __init__(self, options: LoopOptions) -> None:
        from calib.daemon.loop.arm_loop import ArmLoop  # not loaded where only the records are wanted

        self.loop = ArmLoop(options)
        self.controllers = LoopControllers(self.loop.handle)

    def sweep(self, poses: int, seed: int) -> LoopAnswer | None:
        """Ask for a tour of poses."""
        return self.loop.handle(_tour(poses, seed))

    def pump(self) -> list[Message]:
        """Run cycles; returns their messages."""
        return self.loop.run()

    def close(self) -> None:
        """Leave the joints safe."""
        self.loop.close()


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
        options = LoopOptions(
            self.arm, work=self.work, pace=False, seed=self.seed + int(self.now()), open_bus=self._open
        )
        self.host = InlineLoop(options)
        environment = Environment(self.now, self.wall, run_now, self.host)
        self.service = Service(self.arm, self.settings, False, self.directory / "state", self.store, environment)
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
            if self.host.loop.source is None:
                self.simulated.advance(0.1)
            self.view.publish()
            if self.now() - ticked >= 1.0:
                self.service.tick()
                ticked = self.now()

    def kill(self) -> None:
        """As SIGKILL does: nothing is closed, saved or said."""
        self.service.journal.close()
        self.host.loop._source = None

    def kinds(self) -> list[str]:
        return [event.kind for event in self.view.events()]

    def of_kind(self, kind: str) -> list[Any]:
        return [event for event in self.view.events(limit=10_000) if event.kind == kind]
