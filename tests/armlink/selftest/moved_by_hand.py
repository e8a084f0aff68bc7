"""A hand that turns the joints of a simulated arm from stop to stop, and drives whose scales are not as told."""

import numpy as np
import yaml

from armlink.arm_file import bundled_arms, load_arm, parse_arm
from armlink.link.link import Link
from armlink.selftest.scale_motion import JointScales, judge_by_hand, judge_by_motion
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

SECONDS = 6.0
ALL = (
    "six-damiao",
    "six-robstride",
    "six-moteus",
    "six-odrive",
    "six-cia402",
    "six-cubemars",
    "six-myactuator",
    "six-piper",
)


class Hand:
    """Turns every joint once from stop to stop and back within SECONDS, each at its own pace, stops touched."""

    def __init__(self, sim: SimulatedArm, seed: int) -> None:
        self.sim, self.start = sim, sim.time
        random = np.random.default_rng(seed)
        self.turns, self.phase = random.uniform(1.0, 1.5, sim.n), random.uniform(0, 2 * np.pi, sim.n)
        sim.plant.model.opt.gravity[:] = 0.0  # the hand carries the arm
        self.advance, sim.advance = sim.advance, self.turn
        for _ in range(50):
            self.turn(0.004)
            sim._sample()

    def turn(self, duration: float) -> None:
        self.advance(duration)
        plant = self.sim.plant
        middle, half = (plant.lower + plant.upper) / 2, (plant.upper - plant.lower) / 2
        omega = 2 * np.pi * self.turns / SECONDS
        angle = omega * (self.sim.time - self.start) + self.phase
        plant._enter(middle + half * np.sin(angle), half * omega * np.cos(angle), np.zeros(self.sim.n))

    def let_go(self) -> None:
        del self.sim.advance


def arm_with(name: str, off: dict[int, tuple[str, float]]):
    """The bundled arm; of CiA 402 drives the units in the arm file are what is off."""
    path = bundled_arms()[name]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if name == "six-cia402":
        unit = 2 * np.pi / 2**20
        for joint, (quantity, factor) in off.items():
            row = content["link"]["joints"][joint]
            if quantity == "torque":
                row["rated_torque"] /= factor
            else:
                row["drive"][f"{quantity}_unit"] = unit / factor
    return parse_arm(content, path)


def judged(name: str, off: dict[int, tuple[str, float]], seed: int = 0) -> list[list[str]]:
    """What was found off on each joint, `a or b` where the evidence cannot tell; a hand first, then this host."""
    arm, true = arm_with(name, off), load_arm(name)
    found: list[set[str]] = [set() for _ in range(6)]
    for by_whom in ("hand", "host"):
        sim = SimulatedArm(true, Truth.draw(true, seed), seed)
        if name != "six-cia402":
            for joint, (quantity, factor) in off.items():
                sim.device(joint).inject(f"scale.{quantity}", factor)
        bus = LockStepBus(arm=sim)
        link = Link(arm, bus)
        if by_whom == "hand":
            hand = Hand(sim, seed)
            results = judge_by_hand(link, lambda text: None, SECONDS)
            hand.let_go()
        else:
            results = judge_by_motion(link, lambda text: None)
            link.stop()
        for names, each in zip(found, results, strict=True):
            names |= named(each)
        bus.shutdown()
    return [sorted(names) for names in found]


def named(each: JointScales) -> set[str]:
    return {" or ".join(finding.quantities) for finding in each.findings}
