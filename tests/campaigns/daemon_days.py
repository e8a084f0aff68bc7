"""Campaign: the daemon over simulated days: quiet, drifts, payloads, slow drift, two joints at once; speed and memory.

python tests/campaigns/daemon_days.py [--hours 24] [--payloads 100] [--seeds 3] [--only quiet …]
Exit status 1 if a bound fails. The service as it is on a simulated seven-joint arm in ordinary motion, sample by
sample (noise of 0.2 % of rated torque, quantisation, dynamics while it moves), without frames; `frames` has everything:
physics, Coulomb friction of 5 % of rated torque, frames and the bus loop, in lock-step.
"""

import argparse
import gc
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))

from bounds import exit_status
from daemon_bench import DaemonBench
from fast_daemon import FastDaemon, settings

from armlink.arm_file import load_arm

FOUND_SECONDS, GAIN_LEFT, OFFSET_LEFT, FOLLOWED, TOLD, GROWTH = 60.0, 0.003, 0.05, 0.002, 0.98, 0.01
"""Bounds: median time to find, errors after recalibration, error while following, payloads told, memory."""
HEAVY = 3.0
"""A gain drift is asked for on joints whose gravity torque varies by more [N·m]."""


def daemon(seed: int, policy: str = "apply") -> FastDaemon:
    folder = Path(tempfile.mkdtemp(prefix="armlink-days-"))
    return FastDaemon(folder, seed, settings(policy))


def memory() -> float:
    """Resident memory now [MB]."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def quiet(given: argparse.Namespace) -> list[str]:
    """No drift: nothing is recalibrated, memory stays, faster than real time."""
    there = daemon(1)
    there.run(3600)
    before, began = memory(), time.monotonic()
    there.run((given.hours - 1) * 3600)
    spent, growth = time.monotonic() - began, memory() / before - 1
    alarms, written = len(there.of_kind("alarm")), len(there.of_kind("recalibration", "proposal"))
    print(
        f"quiet: {given.hours:g} h, {there.view.status().rows} stops, {alarms} alarms, {written} recalibrations, "
        f"memory {before:.1f} MB {growth:+.2%}, {(given.hours - 1) * 3600 / spent:.0f} times real time",
        flush=True,
    )
    wrong = ["a false recalibration"] * bool(written) + [f"memory grew by {growth:.2%}"] * (growth >= GROWTH)
    return wrong + ["slower than real time"] * (spent > given.hours * 3600)


def drifts(given: argparse.Namespace) -> list[str]:
    """One joint's sensor changes: found, put right."""
    wrong, heavy = [], daemon(0).fast.rms_torque() > HEAVY
    for kind in ("offset", "gain"):
        for joint in range(len(heavy)):
            results = [drift(kind, joint, 100 * joint + seed) for seed in range(given.seeds)]
            found = [result["found"] for result in results]
            gain = max(result["gain"] for result in results)
            offset = max(result["offset"] for result in results)
            others = max(result["others"] for result in results)
            written = [result["written"] for result in results]
            name = f"{kind} of joint_{joint + 1}"
            print(
                f"drift: {name}: found after {np.median(found):.0f} s, written after {np.median(written):.0f} s, "
                f"left {gain:.3%} and {offset:.3f} N·m, other joints written {others}",
                flush=True,
            )
            if kind == "gain" and not heavy[joint]:
                continue
            wrong += [f"{name}: found after {np.median(found):.0f} s"] * bool(np.median(found) > FOUND_SECONDS)
            wrong += [f"{name}: left {gain:.3%}, {offset:.3f} N·m"] * bool(gain > GAIN_LEFT or offset > OFFSET_LEFT)
            wrong += [f"{name}: another joint was written"] * bool(others)
    return wrong


def drift(kind: str, joint: int, seed: int) -> dict[str, Any]:
    there = daemon(seed)
    there.run(120)
    sign = 1 if seed % 2 else -1
    if kind == "offset":
        there.fast.offset[joint] += 0.2 * sign
    else:
        there.fast.gain[joint] *= 1 + 0.01 * sign
    at, name = there.now(), f"joint_{joint + 1}"
    there.run(900, until=lambda: bool(there.of_kind("recalibration")))
    found = [event.t - at for event in there.of_kind("alarm", "drift") if event.joint == name and event.t >= at]
    written = there.of_kind("recalibration")
    gain, offset = (float(np.abs(error[joint])) for error in there.fast.error())
    others = sum(event.joint != name for event in written)
    first = written[0].t - at if written else np.inf
    return {"found": min(found, default=np.inf), "written": first, "gain": gain, "offset": offset, "others": others}


def frames(given: argparse.Namespace) -> list[str]:
    """Drifts and payloads with physics, friction and frames: one run each."""
    wrong, heavy = [], daemon(0).fast.rms_torque() > HEAVY
    found: dict[str, list[float]] = {"offset": [], "gain": []}
    for kind, joint in product(found, range(len(heavy))):
        if kind == "gain" and not heavy[joint]:
            continue
        there = whole(joint)
        there.run(60)
        sign = 1 if joint % 2 else -1
        there.simulated.drift(joint, 1 + 0.01 * sign * (kind == "gain"), 0.2 * sign * (kind == "offset"))
        at, name = there.now(), f"joint_{joint + 1}"
        last = there.service.journal.last_event
        there.run(600, until=lambda there=there, last=last: "recalibration" in kinds(there, last))
        events = there.view.events(after=last)
        first = min((e.t - at for e in events if e.kind in ("alarm", "drift") and e.joint == name), default=np.inf)
        written = [(event.t - at, event.joint) for event in events if event.kind == "recalibration"]
        held = there.host.controllers.read_calibration(joint)
        gain = abs(there.simulated.true_sensors.gain[joint] / held.gain - 1)
        offset = abs(there.simulated.true_sensors.offset[joint] - held.offset) / held.gain
        there.host.close()
        found[kind].append(first)
        print(
            f"frames: {kind} of {name}: found {first:.0f} s, written {written}, left {gain:.3%}, {offset:.3f} N·m",
            flush=True,
        )
        right = [joint for _, joint in written] == [name] and gain < GAIN_LEFT and offset < OFFSET_LEFT
        wrong += [f"frames: {kind} of {name}: {written}, left {gain:.3%}, {offset:.3f} N·m"] * (not right)
    medians = {kind: float(np.median(times)) for kind, times in found.items()}
    wrong += [f"frames: {kind} found after {time:.0f} s" for kind, time in medians.items() if time > FOUND_SECONDS]
    return wrong + picked_up(given)


def kinds(there: DaemonBench, after: int) -> list[str]:
    """Kinds of the events after an id."""
    return [event.kind for event in there.view.events(after=after)]


def picked_up(given: argparse.Namespace) -> list[str]:
    """Payloads with physics, friction and frames; before each the arm is watched without a change."""
    random, wrong = np.random.default_rng(9), []
    there = whole(10)
    for _ in range(given.seeds):
        there.run(60)
        last, mass, point = there.service.journal.last_event, random.uniform(0.5, 3.0), random.uniform(-0.1, 0.1, 3)
        there.simulated.attach_mass(mass, point)
        there.run(70)
        there.simulated.detach_mass()
        events = there.view.events(after=last)
        told = [f"{event.evidence['mass']:.3f} kg" for event in events if event.kind == "payload"]
        others = [event.kind for event in events if event.kind in ("drift", "proposal")]
        print(f"frames: payload of {mass:.3f} kg: told {told}, drifts {others}", flush=True)
        wrong += [f"frames: payload of {mass:.3f} kg: {told}, {others}"] * (not told or bool(others))
    there.host.close()
    return wrong


def whole(seed: int) -> DaemonBench:
    """A daemon on the simulated arm with all there is, friction as random arms have it."""
    arm = load_arm("sarcos")
    joints = arm.require_link().joints
    effects = [
        {"effect": "friction.coulomb", "joint": each.name, "torque": 0.05 * each.rated_torque} for each in joints
    ]
    section = type(arm.sim).model_validate({**arm.sim.model_dump(), "effects": effects})
    folder = Path(tempfile.mkdtemp(prefix="armlink-days-"))
    return DaemonBench(folder, arm.model_copy(update={"sim": section}), seed, settings("apply"))


def payloads(given: argparse.Namespace) -> list[str]:
    """Picked up, carried, put down: told from drift, mass and centre of mass reported, nothing written."""
    told, written, masses, centres = 0, 0, [], []
    random = np.random.default_rng(7)
    there = daemon(500)
    there.run(120)
    for _ in range(given.payloads):
        mass, point = random.uniform(0.5, 3.0), random.uniform(-0.15, 0.15, 3)
        last = there.service.journal.last_event
        there.fast.carry(mass, point)
        there.run(float(random.uniform(60, 120)))
        there.fast.put_down()
        there.run(60)
        events = [event for event in there.view.events(after=last) if event.kind in ("payload", "proposal", "drift")]
        seen = [event for event in events if event.kind == "payload"]
        told += bool(seen) and not any(event.kind == "drift" for event in events)
        written += sum(event.kind == "proposal" for event in events)
        if seen:
            masses.append(seen[0].evidence["mass"] - mass)
            centres.append(np.abs(np.array(seen[0].evidence["com"]) - point).max())
    print(
        f"payloads: {told} of {given.payloads} told from drift, {written} written, mass within "
        f"{np.abs(masses).max() * 1e3:.1f} g, centre of mass within {max(centres) * 1e3:.1f} mm",
        flush=True,
    )
    return ["payloads taken for drift"] * (told < TOLD * given.payloads) + ["a payload was written"] * bool(written)


def slow(given: argparse.Namespace) -> list[str]:
    """0.5 % an hour on one joint for hours, the daemon recalibrating by itself."""
    wrong = []
    for joint, seed in ((1, 600), (3, 601))[: given.seeds]:
        there, worst, estimate = daemon(seed), 0.0, 0.0
        there.run(300)
        for minute in range(round(given.slow_hours * 60)):
            for _ in range(4):
                there.fast.gain[joint] *= 1 + 0.005 / 240
                there.run(15)
            left = there.fast.error()[0][joint]
            worst = max(worst, abs(left))
            believed = there.view.estimates()[joint].gain - 1
            estimate = max(estimate, abs(believed - left)) if minute > 10 else estimate
        writes = len(there.of_kind("recalibration"))
        others = {event.joint for event in there.of_kind("recalibration")} - {f"joint_{joint + 1}"}
        print(
            f"slow: 0.5 %/h on joint_{joint + 1}: readings within {worst:.3%}, estimate within {estimate:.3%}, "
            f"{writes} recalibrations, of other joints {sorted(others)}",
            flush=True,
        )
        wrong += [f"slow drift of joint_{joint + 1}: followed within {estimate:.3%}"] * bool(estimate > FOLLOWED)
    return wrong


def two(given: argparse.Namespace) -> list[str]:
    """A step on one joint and a ramp on another at the same time."""
    wrong = []
    for seed in range(given.seeds):
        there = daemon(700 + seed)
        there.run(120)
        there.fast.offset[1] += 0.5
        for _ in range(60):
            there.fast.gain[2] *= 1 + 0.03 / 60
            there.run(3)
        there.run(1500)
        gain, offset = (np.abs(error).max() for error in there.fast.error())
        print(f"two: a step on joint_2, a ramp on joint_3: left {gain:.3%} and {offset:.3f} N·m", flush=True)
        wrong += [f"two at once: {gain:.3%}, {offset:.3f} N·m"] * bool(gain > GAIN_LEFT or offset > OFFSET_LEFT)
    return wrong


SCENARIOS: dict[str, Callable[[argparse.Namespace], list[str]]] = {
    each.__name__: each for each in (drifts, payloads, slow, two, quiet, frames)
}


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--payloads", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--slow-hours", type=float, default=6.0)
    parser.add_argument("--only", nargs="*", choices=sorted(SCENARIOS), default=list(SCENARIOS))
    given = parser.parse_args()
    import logging

    logging.getLogger("armlink.daemon").setLevel(logging.CRITICAL)
    wrong = [line for name in given.only for line in SCENARIOS[name](given)]
    return exit_status(wrong)


if __name__ == "__main__":
    sys.exit(main())
