"""False readings of every family's drives: is the arm stopped before it is fast, or past a stop?

`false_readings.py [--draws 100] [--seed 1] [--family six-damiao …] [--units]`; a draw is a pose, a job and one
falsehood about one joint: its position, velocity or torque frozen, forged or doubled (by a second node that sends in
its name), or scaled by 0.2 to 5. The job is a motion under position control, or torque control of that joint with a
push besides gravity. All is in lock-step; speeds and angles are the true ones of the simulated plant, from the end of
the set-up to the cycle in which the host notices; speeds, until a joint strikes a stop, which throws the others. As
many sound draws are moved, and none of them may be refused. With `--units` a position that is coded by another scale
is that of a stock drive whose `position_unit` is false in the arm file: its velocity is coded alike, no reading
contradicts another, and the arm file's warning and `armlink check --scales` are what there is. Exit status 0 where no
joint turned 1.5 times as fast as max_velocity, none was 0.1 rad past a stop, and no sound arm was refused.
"""

import argparse
import sys
from dataclasses import dataclass

import numpy as np
import yaml

from armlink.arm_file import ArmFile, bundled_arms, load_arm, parse_arm
from armlink.errors import ArmlinkError
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.fault_kinds import Fault
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.drives.drive_faults import QUANTITIES
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

ALL = (
    *("six-damiao", "six-robstride", "six-cubemars", "six-moteus", "six-odrive", "six-myactuator"),
    *("six-piper", "six-cia402", "sarcos"),
)
HOW = ("forged", "frozen", "doubled", "scaled")
LEAST, MOST = 0.2, 5.0
"""Factors of scaled readings."""
CARRYING = 3
"""Falsehoods about torque are drawn on the joints that carry the others, the first three: the others make little."""
HOLD_SECONDS, JOB_SECONDS = 1.0, 3.0
TAKE_UP_SECONDS = 0.6
"""Time in which a hand lets go of an arm that has just been enabled: its joints take up their loads."""
FASTEST = 1.5
"""Times max_velocity."""
PAST_A_STOP = 0.1
"""[rad]."""


@dataclass(frozen=True)
class Draw:
    """What one run does, and what is false in it."""

    name: str
    seed: int
    joint: int
    fault: str
    """`forged.velocity`; empty: a sound arm."""
    value: float
    coded: bool
    """The drive codes by another scale from the start on, readings and targets alike."""
    torque: bool
    """Torque control, else position control."""
    begins: float
    """Time in the job [s]."""
    unit: bool = False
    """A position that is coded by another scale has its velocity coded alike."""

    @property
    def words(self) -> str:
        how = "coded" if self.coded else "from " + f"{self.begins:.2f} s"
        job = "torque" if self.torque else "position"
        return f"{self.name} seed {self.seed}: joint {self.joint} {self.fault} {self.value:.3g} {how}, {job} control"


@dataclass(frozen=True)
class Outcome:
    fastest: float
    """Greatest true speed of a joint, as a multiple of its max_velocity."""
    past: float
    """Greatest angle past a stop [rad]."""
    says: str
    """What the host said; empty: nothing."""

    @property
    def held(self) -> bool:
        return self.fastest <= FASTEST and self.past <= PAST_A_STOP


def drawn(name: str, seed: int, sound: bool = False, unit: bool = False) -> Draw:
    """The draw of a seed."""
    random = np.random.default_rng([seed, 606])
    n = len(load_arm(name).joint_names)
    quantity, how = QUANTITIES[seed % 3], HOW[seed // 3 % 4]
    joint = int(random.integers(CARRYING if quantity == "torque" else n))
    factor = float(np.exp(random.uniform(np.log(LEAST), np.log(MOST))))
    forged = {"position": 1.5, "velocity": 1.0, "torque": 10.0}[quantity] * float(random.uniform(-1, 1))
    tells_its_units = name == "sarcos"
    if how == "scaled" and quantity == "position" and tells_its_units:
        quantity = "velocity"
    coded = how == "scaled" and not tells_its_units and (quantity == "position" or random.random() < 0.5)
    torque, begins = bool(random.random() < 0.5), float(random.uniform(0.0, 0.8))
    if quantity == "torque" and not coded:
        begins = -0.3 * begins  # so that it is false when torque control begins
    value = factor if how == "scaled" else forged if how == "forged" else 0.0
    fault = "" if sound else f"{how}.{quantity}"
    return Draw(name, seed, joint, fault, value, coded and not sound, torque and not sound, begins, unit)


def arms_of(draw: Draw) -> tuple[ArmFile, ArmFile]:
    """The arm as it is, and as its file says: CiA 402 drives that code by another scale are those of a false unit."""
    true = load_arm(draw.name)
    if not (draw.coded and true.require_link().joints[0].settings.family == "canopen"):
        return true, true
    path = bundled_arms()[draw.name]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    row, quantity = content["link"]["joints"][draw.joint], draw.fault.partition(".")[2]
    unit = 2 * np.pi / 2**20 / draw.value
    if quantity == "torque":
        row["rated_torque"] /= draw.value
    elif "drive" in row:
        row["drive"][f"{quantity}_unit"] = unit
        if quantity == "position" and not draw.unit:
            row["drive"]["velocity_unit"] = unit * draw.value
    return true, parse_arm(content, path)


class Run:
    """One arm under one job."""

    def __init__(self, draw: Draw) -> None:
        self.draw = draw
        true, told = arms_of(draw)
        self.sim = sim = SimulatedArm(true, Truth.of(true), draw.seed)
        self.bus = LockStepBus(arm=sim)
        self.random = np.random.default_rng([draw.seed, 707])
        plant = sim.plant
        self.lower, self.upper = plant.lower, plant.upper
        self.most = np.array([joint.max_velocity for joint in true.require_link().joints])
        for joint in range(sim.n):
            sim.turn_by_hand(joint, float(self.random.uniform(self.lower[joint] + 0.1, self.upper[joint] - 0.1)))
        self.gravity = plant.model.opt.gravity.copy()
        plant.model.opt.gravity[:] = 0.0  # a hand carries the arm
        sim.advance(0.5)
        if draw.coded and true is told:
            sim.device(draw.joint).inject(f"scale.{draw.fault.partition('.')[2]}", draw.value)  # type: ignore[union-attr]
        self.link = Link(told, self.bus)
        self.fastest = self.past = 0.0
        self.advance, sim.advance = sim.advance, self._watched  # type: ignore[method-assign]
        self.watching = False

    def _watched(self, duration: float) -> None:
        self.advance(duration)
        if self.watching:
            plant = self.sim.plant
            beyond = np.maximum(self.lower - plant.position, plant.position - self.upper)
            self.past = max(self.past, float(beyond.max()))
            if self.past <= 0.0:
                self.fastest = max(self.fastest, float((np.abs(plant.velocity) / self.most).max()))

    def outcome(self) -> Outcome:
        says = ""
        try:
            self._work()
        except ArmlinkError as error:
            says = f"{type(error).__name__}: {error}"
        self.bus.shutdown()
        return Outcome(self.fastest, self.past, says)

    def _work(self) -> None:
        link, draw, period = self.link, self.draw, self.link.period
        link.start()
        hold = Command.hold(link.enable().position)
        for cycle in range(round(HOLD_SECONDS / period)):
            self.watching = draw.coded and cycle * period > TAKE_UP_SECONDS
            self.sim.plant.model.opt.gravity[:] = self.gravity * min(cycle * period / TAKE_UP_SECONDS, 1.0)
            self._begin(cycle * period - HOLD_SECONDS, period)
            link.commander.command(hold)
        self.watching = True
        job = self._torques(hold) if draw.torque else self._positions(hold)
        for cycle, command in enumerate(job):
            self._begin(cycle * period, period)
            link.commander.command(command)

    def _begin(self, time: float, period: float) -> None:
        """The falsehood, where its time has come."""
        draw = self.draw
        if draw.fault and not draw.coded and 0 <= time - draw.begins < period:
            self.bus.inject(Fault(draw.fault, self.sim.names[draw.joint], draw.value))

    def _positions(self, hold: Command):
        """To and fro between drawn poses, as fast as max_velocity allows."""
        start = hold.position
        lower, upper = np.array([(each.lower, each.upper) for each in self.link.limits]).T
        goal = self.random.uniform(lower + 0.1, upper - 0.1)
        seconds = float((np.abs(goal - start) * 1.875 / (0.9 * self.most)).max())
        time = np.arange(0.0, 2 * JOB_SECONDS, self.link.period)
        share = np.clip(time / max(seconds, 0.5), 0.0, 1.0)
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        for row in start + smooth[:, None] * (goal - start):
            yield Command.hold(row)

    def _torques(self, hold: Command):
        """Gravity, and a push that accelerates the joint."""
        joint, sim = self.draw.joint, self.sim
        push = float(self.random.choice((-1, 1)) * self.random.uniform(1.0, 12.0))
        command = Command.hold(hold.position)
        command.mode[joint] = 10
        for _ in range(round(JOB_SECONDS / self.link.period)):
            position = sim.plant.position
            inertia = float(sim.plant.inertia(position)[joint, joint])
            command.torque[joint] = float(sim.gravity_torque(position[None])[0, joint]) + push * inertia
            yield command


def run(draw: Draw) -> Outcome:
    """What came of a draw."""
    return Run(draw).outcome()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", nargs="*", default=list(ALL))
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--units", action="store_true")
    asked = parser.parse_args()
    failed = 0
    for name in asked.family:
        seeds = range(1000 * asked.seed, 1000 * asked.seed + asked.draws)
        false = [(draw, run(draw)) for draw in (drawn(name, seed, unit=asked.units) for seed in seeds)]
        sound = [(draw, run(draw)) for draw in (drawn(name, seed, sound=True) for seed in seeds)]
        wrong = [each for each in false if not each[1].held] + [each for each in sound if each[1].says]
        failed += len(wrong)
        noticed = sum(bool(outcome.says) for _, outcome in false)
        fastest, past = max(each.fastest for _, each in false), max(each.past for _, each in false)
        print(
            f"{name}: {len(false)} false, {noticed} noticed, fastest {fastest:.2f} of max_velocity, {past:.3f} rad "
            f"past a stop; {len(sound)} sound; {len(wrong)} wrong",
            flush=True,
        )
        for draw, outcome in wrong if not asked.verbose else false + sound:
            print(f"  {draw.words}: {outcome.fastest:.2f}, {outcome.past:.3f} rad; {outcome.says[:150]}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
