"""A simulated arm at full stretch with a mass on, whose true joint speeds are watched until its work has ended."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile, load_arm
from armlink.drives.orders import Mode
from armlink.link.link import Link
from armlink.link.park import straight_path
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.physics.plant import Plant
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

FALLING = ("six-damiao", "six-cubemars", "six-robstride", "six-moteus", "six-odrive", "six-myactuator", "six-piper")
MASS = 0.3
"""On the tip [kg]."""
EXTRA_SPEED = 1.0
"""No joint may turn so much faster than its trajectory had it [rad/s]."""


def after_each_step(plant: Plant, look: Callable[[], None]) -> None:
    """Have `look` called whenever the simulated plant has moved on."""
    step = plant.step

    def watched(*args: object) -> None:
        step(*args)  # type: ignore[arg-type]
        look()

    plant.step = watched  # type: ignore[method-assign, assignment]


class EndsBench:
    """An arm led to where gravity pulls most at its shoulder; `peak` is the largest speed of each joint since."""

    def __init__(self, name: str | ArmFile, enable: bool = True) -> None:
        """Enabled, at full stretch, holding; or started, at full stretch, carried until the drives have power."""
        arm = load_arm(name) if isinstance(name, str) else name
        self.arm = arm
        self.sim = SimulatedArm(arm, Truth.of(arm), 1)
        self.bus = LockStepBus(arm=self.sim)
        self.peak = np.zeros(6)
        self.link = Link(arm, self.bus)
        if not enable:
            self._carry()
            return
        self.link.start()
        self.link.enable()
        here = self.link.position_sent
        for target in straight_path(here, self.stretched(), np.full(6, 1.0), self.link.period):
            self.link.cycle(Command.hold(target))
        self.sim.attach_mass(MASS)
        self.hold(1.0)
        after_each_step(self.sim.plant, self._look)

    def _carry(self) -> None:
        """A hand carries the arm, and lets go of it in the second second of its enabling."""
        plant, stretched = self.sim.plant, self.stretched()
        weight, cycles = plant.model.opt.gravity.copy(), itertools.count()
        plant.model.opt.gravity[:] = 0.0
        for joint, position in enumerate(stretched):
            self.sim.turn_by_hand(joint, float(position))
        self.sim.advance(0.5)
        self.link.start()
        second, stand = self.link.rate, self.link.commander.stand

        def let_go(*args: Any, **kwargs: Any) -> Any:
            plant.model.opt.gravity[:] = weight * min(max(next(cycles) - second, 0.0) / second, 1.0)
            return stand(*args, **kwargs)

        self.link.commander.stand = let_go  # type: ignore[method-assign]
        after_each_step(plant, self._look)

    def _look(self) -> None:
        self.peak = np.maximum(self.peak, np.abs(self.sim.plant.velocity))

    def stretched(self) -> np.ndarray:
        """A pose, 0.15 rad within the stops, whose gravity torque is large and within what the joints may make."""
        random = np.random.default_rng(3)
        lower, upper = (
            np.array([getattr(each, key) for each in self.arm.kinematics.joints]) for key in ("lower", "upper")
        )
        poses = random.uniform(lower + 0.15, upper - 0.15, (4000, 6))
        loads = np.abs(self.sim.gravity_torque(poses))
        most = np.array([joint.max_torque for joint in self.arm.require_link().joints])
        fits = (loads < 0.45 * most).all(axis=1)
        return poses[fits][np.argmax(loads[fits, 1] + loads[fits, 0])]

    def hold(self, seconds: float) -> None:
        """Hold by position control."""
        here = self.link.position_sent
        for _ in range(round(seconds / self.link.period)):
            self.link.cycle(Command.hold(here))

    def float_torque(self, seconds: float) -> None:
        """Torque control without a torque: the arm begins to fall, and the gate refuses."""
        for _ in range(round(seconds / self.link.period)):
            mode = np.full(6, Mode.TORQUE, np.int8)
            self.link.cycle(Command(mode, np.zeros(6), np.full(6, np.nan)))

    def leave(self, error: BaseException | None) -> None:
        """The `with` block of the link ends with this error."""
        self.link.__exit__(None if error is None else type(error), error, None)

    @property
    def powered(self) -> list[bool]:
        """Which motors have power."""
        return [drive.motor.powered for drive in self.sim.drive_at.values()]

    def away(self) -> float:
        """Distance from the parking pose [rad]."""
        return float(np.abs(self.sim.plant.position - self.arm.require_link().park.pose).max())
