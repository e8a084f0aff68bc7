"""Campaign: the observer on arms that differ from their model as real ones do (`sim.realism`), from rest to rest.

python tests/campaigns/observer_arms.py [--levels 1 3] [--draws 20] [--hours 24] [--only drifts …]
Exit status 1 if a bound fails. One draw in three is the bundled arm `sarcos`, the others are random ones of 3 to 7
joints; statics by the simulated arm's own physics, models by least squares as a calibration leaves them.
"""

import argparse
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))

from bounds import exit_status
from drawn_arms import drawn_arm
from real_arm import RealArm

from calib.observer.decision import Event
from calib.observer.evidence import DRIFT
from calib.observer.observer import Observer

GAIN, OFFSET = {1: 0.03, 3: 0.05}, {1: 0.02, 3: 0.04}
"""Changes by level: of a gain, and of an offset as a share of rated torque."""
HEAVY = 0.2
"""A joint whose gravity torque varies by this share of rated torque (standard deviation over the range) is loaded."""
LEARNING, MOST = 300.0, 600.0
"""Work before a change, and the longest work after it [s]."""
FOUND, TOLD, NOTICED, MISSED, INSIDE = 0.95, 0.90, 0.90, 0.10, 0.90
"""Shares asked for: drifts found, payloads told, 1.5 times the limit found, half of it found at most, intervals of
95 % that hold (of a few dozen)."""
WINDOW = 2.6
"""Half width of the interval judged, in standard deviations: 99 %."""


@dataclass
class Case:
    """One arm with its observer, that has worked a while."""

    arm: RealArm
    observer: Observer
    random: np.random.Generator

    @classmethod
    def drawn(cls, level: float, seed: int, learning: float = LEARNING) -> "Case":
        """A case of its own; the work before the change is done once for all scenarios."""
        return deepcopy(_worked(level, seed, learning))

    def work(self, seconds: float, until: Callable[[list[Event]], bool] = lambda events: False) -> list[Event]:
        """Events of so long, with their times from its beginning."""
        events: list[Event] = []
        end = self.arm.t + seconds
        while self.arm.t < end and not until(events):
            events += self.arm.work(self.observer, 1)
        return events

    def sensor(self, joint: int) -> tuple[float, float]:
        """Gain and offset of a joint's readings as the controller sends them."""
        arm = self.arm
        return arm.gain[joint] / arm.held_gain[joint], (arm.offset - arm.held_offset)[joint] / arm.held_gain[joint]


@cache
def _worked(level: float, seed: int, learning: float) -> Case:
    file = "sarcos" if seed % 3 == 0 else drawn_arm(seed)[0]
    arm = RealArm(file, level, seed)
    case = Case(arm, arm.observer(), np.random.default_rng([seed, 17]))
    case.work(learning)
    return case


def is_drift_of(event: Event, joint: str) -> bool:
    """Whether an event says that this joint's sensor drifts."""
    return event.joint == joint and event.kind == "verdict" and event.evidence["cause"] in DRIFT


def changed(case: Case, level: int) -> tuple[int, float, float, str]:
    """Change a sensor: joint, gain, offset [N·m], in words."""
    arm, random = case.arm, case.random
    share, limits = arm.rms_torque() / arm.rated, case.observer.limits()
    sign, joint = random.choice([-1, 1]), int(random.integers(arm.n))
    gain, offset = 1.0, sign * OFFSET[level] * arm.rated[joint]
    if random.random() < 0.5 and np.isfinite(limits.gain[joint]):
        size = GAIN[level] if share[joint] >= HEAVY else 1.5 * limits.gain[joint]
        gain, offset = 1.0 + sign * size, 0.0
    arm.gain[joint] *= gain
    arm.offset[joint] = arm.offset[joint] * gain + offset
    return joint, gain, offset, f"{arm.arm.names[joint]} of {arm.n}: gain {gain:.4f}, offset {offset:+.3f} N·m"


def drifts(level: int, given: argparse.Namespace) -> list[str]:
    """A sensor changes: found on the right joint and put right."""
    found, inside, wrong, times = 0, [], 0, []
    for seed in range(given.first, given.first + given.draws):
        case = Case.drawn(level, seed)
        before = [case.sensor(j) for j in range(case.arm.n)]
        joint, _, _, words = changed(case, level)
        name, began = case.arm.arm.names[joint], case.arm.t
        events = case.work(MOST, lambda events, name=name: any(e.finding and e.joint == name for e in events))
        said = [event.t - began for event in events if is_drift_of(event, name)]
        found += bool(said)
        times += said[:1]
        others = [event.joint for event in events if event.finding and event.joint != name]
        wrong += bool(others)
        holds = "not written"
        for event in events:
            if event.finding and event.joint == name:
                now, std = case.sensor(joint), event.finding.std
                gain = now[0] / before[joint][0]
                left = gain - 1, now[1] - gain * before[joint][1]
                inside += [abs(each) <= WINDOW * s for each, s in zip(left, std, strict=True) if s > 0]
                holds = f"left {left[0]:.2%} ± {std[0]:.2%}, {left[1]:.3f} ± {std[1]:.3f} N·m"
        tell = (
            "" if said else str([(round(e.t - began), e.kind, e.joint, e.evidence.get("cause")) for e in events][-6:])
        )
        print(
            f"drifts: level {level}, draw {seed}: {words}: found {said[:1]}, others {others}, {holds} {tell}",
            flush=True,
        )
    held = float(np.mean(inside)) if inside else 0.0
    print(
        f"drifts: level {level}: {found} of {given.draws} found, median {np.median(times or [np.inf]):.0f} s, longest "
        f"{max(times, default=np.inf):.0f} s, other joints written {wrong}, intervals {held:.0%} of {len(inside)}"
    )
    failed = [f"level {level}: {found} of {given.draws} drifts"] * (found < FOUND * given.draws)
    return failed + [f"level {level}: {held:.0%} of intervals"] * (held < INSIDE)


def payloads(level: int, given: argparse.Namespace) -> list[str]:
    """5 to 30 % of the last three links' mass picked up and put down."""
    told, written, held = 0, 0, 0
    for seed in range(given.first, given.first + given.draws):
        case = Case.drawn(level, seed)
        mass = case.random.uniform(0.05, 0.3) * sum(link.mass for link in case.arm.file.sim.links[-3:])
        case.arm.carry(mass, case.random.uniform(-0.1, 0.1, 3))
        events = case.work(120.0)
        seen = [event.evidence["mass"] for event in events if event.evidence.get("cause") == "payload"]
        case.arm.put_down()
        events += case.work(180.0)
        drift = [event.joint for event in events if event.evidence.get("cause") in DRIFT]
        told += bool(seen) and not drift
        written += sum(event.finding is not None for event in events)
        held += case.observer.held
        print(f"payloads: level {level}, draw {seed}: {mass:.3f} kg told {seen}, drifts {drift}", flush=True)
    print(f"payloads: level {level}: {told} of {given.draws} told, {written} written, {held} left held")
    wrong = [f"level {level}: {told} of {given.draws} payloads"] * (told < TOLD * given.draws)
    return wrong + [f"level {level}: a payload was written"] * bool(written)


def contacts(level: int, given: argparse.Namespace) -> list[str]:
    """Collisions and a hand that leans on the arm: nothing is written, and the observer is not left undecided."""
    written, held = 0, 0
    for seed in range(given.first, given.first + given.draws):
        case = Case.drawn(level, seed)
        arm, random, size = case.arm, case.random, case.random.uniform(0.02, 0.1)
        events = []
        for rests in (2, 20):
            push = size * arm.rated * random.normal(size=arm.n)
            arm.push = lambda q, push=push: push * np.sin(3.0 * q)
            events += arm.work(case.observer, rests)
            arm.push = None
            events += case.work(150.0)
        written += sum(event.finding is not None for event in events)
        held += case.observer.held
        told = [(event.kind, event.joint, event.evidence.get("cause")) for event in events][:6]
        print(f"contacts: level {level}, draw {seed}: {size:.1%}, held {case.observer.held}, {told}", flush=True)
    print(f"contacts: level {level}: {written} written, {held} of {given.draws} left held")
    return [f"level {level}: a contact was written"] * bool(written) + [f"level {level}: left held"] * bool(held)


def warm_up(level: int, given: argparse.Namespace) -> list[str]:
    """From cold: nothing is written in an hour."""
    written, told, hours = 0, 0, 1.0
    for seed in range(given.first, given.first + given.draws):
        case = Case.drawn(level, seed, 0.0)
        case.arm.cold_at = 0.0
        events = case.work(hours * 3600)
        written += sum(event.finding is not None for event in events)
        told += len(events)
        print(f"warm_up: level {level}, draw {seed}: {[(round(e.t), e.kind, e.joint) for e in events][:6]}", flush=True)
    print(f"warm_up: level {level}: {written} written, {told} events in {given.draws * hours:g} h")
    wrong = [f"level {level}: written while warming up: {written}"] * bool(written)
    return wrong + [f"level {level}: {told} events while warming up"] * (told > max(1.0, given.draws * hours / 24))


def slow(level: int, given: argparse.Namespace) -> list[str]:
    """0.5 % an hour on a loaded joint for three hours: not learned away."""
    wrong = []
    for seed in range(given.first, given.first + given.draws):
        case = Case.drawn(level, seed)
        arm = case.arm
        joint = int(np.argmax(arm.rms_torque() / arm.rated))
        limit, worst, estimate = case.observer.limits().gain[joint], 0.0, 0.0
        before, events = case.sensor(joint)[0], []
        for _ in range(180):
            arm.gain[joint] *= 1 + 0.005 / 60
            events += case.work(60.0)
            left = case.sensor(joint)[0] / before - 1
            worst = max(worst, abs(left))
            if not case.observer.held:
                estimate = max(estimate, abs(case.observer.estimate().gain[joint] - 1 - left))
        written = {event.joint for event in events if event.finding}
        print(
            f"slow: level {level}, draw {seed}: limit {limit:.2%}, readings within {worst:.2%}, estimate within "
            f"{estimate:.2%}, written {sorted(written)}",
            flush=True,
        )
        wrong += [f"level {level}, draw {seed}: slow drift"] * bool(worst > max(0.005, 1.5 * limit))
        wrong += [f"level {level}, draw {seed}: another joint written"] * bool(written - {arm.arm.names[joint]})
    return wrong


def noticed(level: int, given: argparse.Namespace) -> list[str]:
    """The limit that the observer tells: 1.5 times it is found, half of it is not."""
    wrong = []
    for factor in given.factors:
        count = 0
        for seed in range(given.first, given.first + given.draws):
            case = Case.drawn(level, seed)
            limits, joint = case.observer.limits(), int(case.random.integers(case.arm.n))
            sign, name = case.random.choice([-1, 1]), case.arm.arm.names[joint]
            if seed % 2 and np.isfinite(limits.gain[joint]):
                case.arm.gain[joint] *= 1 + sign * factor * limits.gain[joint]
                words = f"gain {factor * limits.gain[joint]:.2%}"
            else:
                case.arm.offset[joint] += sign * factor * limits.offset[joint]
                words = f"offset {factor * limits.offset[joint] / case.arm.rated[joint]:.2%} of rated torque"
            events = case.work(MOST, lambda events, name=name: any(is_drift_of(event, name) for event in events))
            seen = any(is_drift_of(event, name) for event in events)
            count += seen
            print(f"noticed: level {level}, draw {seed}: {factor} times the limit: {name} {words}: {seen}", flush=True)
        print(f"noticed: level {level}: of {factor} times the limit {count} of {given.draws} found")
        share = count / given.draws
        bad = share < NOTICED if factor > 1 else share > MISSED
        wrong += [f"level {level}: {factor} times the limit: {count} of {given.draws}"] * bool(bad)
    return wrong


def quiet(level: int, given: argparse.Namespace) -> list[str]:
    """Hours of work while the zeros follow the room's temperature: nothing is written, at most one event a day."""
    wrong = []
    for seed in range(given.first, given.first + max(1, given.draws // 20)):
        case = Case.drawn(level, seed, 0.0)
        size = case.arm.state.warm_up[:, 0].copy()
        case.arm.zero = lambda t, size=size: size * np.sin(2 * np.pi * t / 14400.0) / 2
        events = list[Event]()
        for hour in range(given.hours):
            events += case.work((hour + 1) * 3600 - case.arm.t)
            print(f"quiet: level {level}, draw {seed}: hour {hour + 1}, {len(events)} events", flush=True)
        written = [event.joint for event in events if event.finding]
        told = [(round(e.t), e.kind, e.joint, e.evidence.get("cause")) for e in events][:20]
        rests = case.observer.rows
        print(f"quiet: level {level}, draw {seed}: {rests} rests, written {written}, events {told}", flush=True)
        wrong += [f"level {level}, draw {seed}: a false write"] * bool(written)
        wrong += [f"level {level}, draw {seed}: {len(events)} events"] * (len(events) > max(1.0, given.hours / 24))
        wrong += [f"level {level}, draw {seed}: left held"] * case.observer.held
    return wrong


SCENARIOS: dict[str, Callable[[int, argparse.Namespace], list[str]]] = {
    each.__name__: each for each in (drifts, payloads, contacts, warm_up, slow, noticed, quiet)
}


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--levels", type=int, nargs="*", default=[1, 3], choices=sorted(GAIN))
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hours", type=int, default=24)
    parser.add_argument("--factors", type=float, nargs="+", default=[1.5, 0.5], help="of the limit, for noticed")
    parser.add_argument("--only", nargs="*", choices=sorted(SCENARIOS), default=list(SCENARIOS))
    given = parser.parse_args()
    wrong = [line for name in given.only for level in given.levels for line in SCENARIOS[name](level, given)]
    return exit_status(wrong)


if __name__ == "__main__":
    sys.exit(main())
