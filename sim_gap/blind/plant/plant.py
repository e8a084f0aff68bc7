"""Simulates many arms at once: rigid links by MuJoCo's forward dynamics, the rest by leapfrog integration at 0.5 ms.

Links get velocities at half steps from accelerations at full steps. Motors, bristles, backlash and the position
controller (PID with feed-forward of the nominal model, 500 Hz, on a quantised and noisy reading) are arrays over all
arms. The simulation of an arm does not depend on the others of its batch.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import mjcf, quiet
from sim_gap.blind.motion import RATE
from sim_gap.blind.plant.controller import PidControllers
from sim_gap.blind.plant.drive import PlantDrives
from sim_gap.blind.true_arm import Log, PlantRun, TrueArm

SUBSTEPS = 4
STEP = 1.0 / (RATE * SUBSTEPS)
"""Time step [s]: springs must be slower."""
CHANNELS = ("position", "torque", "motor", "command", "angle")


class Commands(Protocol):
    """The controllers of many arms: torques of the first k of them from their exact readings."""

    def command(self, tick: int, reading: Array) -> Array:
        """Torques [N·m], (k, width)."""


Control = Callable[[Sequence[PlantRun], Array, int], Commands]
"""Makes the controllers from the runs, the initial readings (B, width) [rad], and the width."""


def simulate(runs: Sequence[PlantRun], controller: Control = PidControllers) -> list[Log]:
    """Simulate all runs together, each with a controller of this kind, and return their logs in order."""
    order = sorted(range(len(runs)), key=lambda i: -len(runs[i].command))
    logs = _ArmBatch([runs[i] for i in order], controller).run()
    out: list[Log] = [logs[0]] * len(runs)
    for place, i in enumerate(order):
        out[i] = logs[place]
    return out


class _ArmBatch:
    """Arms sorted by the length of their runs, longest first, so that those still moving are always the first k."""

    def __init__(self, runs: list[PlantRun], controller: Control) -> None:
        import mujoco

        self.forward = mujoco.mj_forward
        self.runs, self.width = runs, max(run.truth.n for run in runs)
        self.lengths = [len(run.command) for run in runs]
        shape = (len(runs), self.width)
        self.angle, self.half, self.velocity, self.acceleration, self.force = (np.zeros(shape) for _ in range(5))
        self.worlds = []
        for b, run in enumerate(runs):
            model = true_model(run.truth)
            data, n = mujoco.MjData(model), run.truth.n
            self.angle[b, :n] = _start(run)
            mine = [x[b, :n] for x in (self.angle, self.velocity, self.force, self.acceleration)]
            self.worlds.append((model, data, data.qpos, data.qvel, data.qfrc_applied, data.qacc, *mine))
        truths = [run.truth for run in runs]
        self.drives = PlantDrives(
            truths, self._least_inertia(), self.angle, [run.feed_forward[0] for run in runs], STEP
        )
        self.controller = controller(runs, self.drives.reading(self.angle), self.width)
        self.kept = {name: np.zeros((self.lengths[0], *shape)) for name in CHANNELS}

    def run(self) -> list[Log]:
        k = len(self.runs)
        for tick in range(self.lengths[0]):
            while self.lengths[k - 1] <= tick:
                k -= 1
            reading = self.drives.reading(self.angle[:k])
            command = self.controller.command(tick, reading)
            for sub in range(SUBSTEPS):
                self._step(k, command)
                if sub == 0:
                    self._record(k, tick, reading, command)
                self._move(k)
        sizes = [(length, run.truth.n) for length, run in zip(self.lengths, self.runs, strict=True)]
        return [
            Log(**{name: values[:length, b, :n] for name, values in self.kept.items()})
            for b, (length, n) in enumerate(sizes)
        ]

    def _step(self, k: int, command: Array) -> None:
        """Forces and accelerations now."""
        self.force[:k] = self.drives.forces(self.angle[:k], self.velocity[:k], command)
        for model, data, qpos, qvel, applied, qacc, angle, velocity, force, acceleration in self.worlds[:k]:
            qpos[:], qvel[:], applied[:] = angle, velocity, force
            self.forward(model, data)
            acceleration[:] = qacc

    def _move(self, k: int) -> None:
        """Leapfrog to the next step."""
        a = self.acceleration[:k]
        self.half[:k] += STEP * a
        self.angle[:k] += STEP * self.half[:k]
        self.velocity[:k] = self.half[:k] + 0.5 * STEP * a
        self.drives.move(k)

    def _record(self, k: int, tick: int, reading: Array, command: Array) -> None:
        torque = self.drives.link_torque(self.acceleration[:k])
        for name, now in zip(CHANNELS, (reading, torque, self.drives.current, command, self.angle), strict=True):
            self.kept[name][tick, :k] = now[:k]

    def _least_inertia(self) -> Array:
        """A lower bound of the inertia that each motor moves [kg·m²], (B, width)."""
        out = np.ones(self.angle.shape)
        for b, run in enumerate(self.runs):
            out[b, : run.truth.n] = np.maximum(run.truth.arm.armature, 0.01)
        return out


def _start(run: PlantRun) -> Array:
    """Link angles at which the position sensors read the trajectory's first point, at rest [rad]."""
    truth, reading = run.truth, run.command[0]
    bent = truth.eccentricity[:, 0] * np.sin(reading + truth.eccentricity[:, 1])
    torque = run.feed_forward[0]
    stretch = torque / truth.stiffness + 0.5 * truth.backlash * np.sign(torque)
    return np.asarray(truth.position_gain * reading + truth.position_offset + bent - stretch)


def true_model(truth: TrueArm) -> Any:
    """The arm's rigid mechanics in MuJoCo: true links and the rotors that turn rigidly with them."""
    import mujoco

    rigid = replace(truth.arm, armature=np.where(truth.elastic, 0.0, truth.arm.armature))
    shared = tuple((s.joint, s.other, s.coefficient, s.inertia) for s in truth.shared)
    return quiet(mujoco.MjModel.from_xml_string(mjcf(rigid, shared)))
