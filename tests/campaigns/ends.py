"""Ends of the work at drawn moments: an arm that its drives would let fall, swept or afloat, with a mass on.

`ends.py [--draws 300] [--seed 1] [--family six-damiao …] [--job sweep float] [--cause SIGTERM …]`: one sweep and one
float of each arm in simulated time; at drawn moments a copy of the process (fork) ends the job there by a drawn cause,
and reports the largest true speed of each joint until its power has gone, less what the job's own motion had until
then. A signal is sent to that process and interrupts whatever it is at. Exit status 0 where no joint was faster than
1 rad/s beyond that and every arm was parked.
"""

import argparse
import itertools
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink"))

from ends_bench import EXTRA_SPEED, FALLING, EndsBench

from armlink.arm_file import load_arm
from armlink.drives.orders import Mode
from armlink.errors import BusFault, Refused, Stall
from armlink.link.types import Command
from armlink.termination import terminate_as_interrupt
from calib.arm.kinematics import gcomp_arm
from calib.motion.trajectory import WorkMotion, work_targets

CAUSES: dict[str, Callable[[], BaseException | None]] = {
    "done": lambda: None,
    "exception": lambda: ZeroDivisionError("a drawn moment"),
    "disk full": lambda: OSError(28, "No space left on device"),
    "refused": lambda: Refused("a drawn moment"),
    "stall": lambda: Stall("a drawn moment"),
    "bus fault": lambda: BusFault("a drawn moment"),
    "gate": lambda: None,
}
"""`gate`: torque control without torque until the gate refuses, then the end."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
MISSED_SECONDS = 30.0
"""A job that goes on for so long after its signal has missed it [s of real time]."""
ALL = [*CAUSES, *(number.name for number in SIGNALS)]


def work(bench: EndsBench, seed: int) -> Any:
    """Endless targets over the whole range, as a sweep moves."""
    arm, link = gcomp_arm(bench.arm), bench.link
    speed = np.array([joint.max_velocity for joint in bench.arm.require_link().joints])
    random = np.random.default_rng(seed)
    return work_targets(link.position_sent, arm.lower, arm.upper, speed, link.period, random, WorkMotion(reach=10.0))


def commands(bench: EndsBench, job: str, seed: int) -> Callable[[], None]:
    """One cycle of the job."""
    link = bench.link
    if job == "sweep":
        targets = work(bench, seed)
        return lambda: (link.cycle(Command.hold(next(targets))), None)[1]
    limits = np.array([joint.max_torque for joint in bench.arm.require_link().joints])
    random = np.random.default_rng(seed)
    push = np.zeros(6)

    def step() -> None:
        here = link.latest_position
        push[:] = 0.999 * push + 0.001 * limits * random.normal(size=6)
        torque = bench.sim.gravity_torque(here[None])[0] + push - 0.05 * limits * bench.sim.plant.velocity
        link.cycle(Command(np.full(6, Mode.TORQUE, np.int8), torque, here))

    return step


def signalled(step: Callable[[], None], name: str, seconds: float) -> BaseException:
    """What a signal to this process, after so much real time of its job, raises there."""
    try:
        with terminate_as_interrupt():
            threading.Timer(seconds, os.kill, (os.getpid(), signal.Signals[name])).start()
            asked = time.monotonic()
            while time.monotonic() - asked < MISSED_SECONDS:
                step()
    except (KeyboardInterrupt, Refused) as error:
        return error
    raise SystemExit(f"{name} did not interrupt the job")


def ended(bench: EndsBench, step: Callable[[], None], cause: str, seconds: float) -> dict[str, Any]:
    """End the job here; what came of the arm."""
    bench.peak[:] = np.abs(bench.sim.plant.velocity)
    own = np.array([joint.max_velocity for joint in bench.arm.require_link().joints])
    error = CAUSES[cause]() if cause in CAUSES else signalled(step, cause, seconds)
    if cause not in CAUSES and isinstance(error, Refused):  # a late machine: the float went on until the gate refused
        return {"early": True}
    if cause == "gate":
        try:
            bench.float_torque(5.0)
        except Refused as refused:
            error, own = refused, 1.5 * own
    bench.leave(error)
    over = bench.peak - own
    return {"over": float(over.max()), "away": bench.away(), "powered": any(bench.powered)}


def campaign(name: str, job: str, causes: list[str], draws: int, seed: int) -> list[dict[str, Any]]:
    """One job of one arm, ended at drawn moments."""
    random = np.random.default_rng([seed, FALLING.index(name), job == "float"])
    bench = EndsBench(load_arm(name))
    step, found = commands(bench, job, seed), []
    number = -1
    while len(found) < draws:
        number += 1
        for _ in range(int(random.integers(5, 100))):
            try:
                step()
            except Refused:  # the push was too much
                bench.link.recover()
        cause, seconds = causes[int(random.integers(len(causes)))], float(random.uniform(0.0, 0.05))
        with tempfile.TemporaryFile("w+") as answer:
            child = os.fork()
            if child == 0:
                try:
                    json.dump(ended(bench, step, cause, seconds), answer)
                    answer.flush()
                finally:
                    os._exit(0)
            os.waitpid(child, 0)
            answer.seek(0)
            text = answer.read()
        result = json.loads(text) if text else {"over": float("inf"), "away": float("inf"), "powered": True}
        if "early" in result:
            continue
        found.append({"name": name, "job": job, "number": number, "cause": cause, **result})
        good = result["over"] < EXTRA_SPEED and result["away"] < 0.1 and not result["powered"]
        if not good:
            print(json.dumps(found[-1]), flush=True)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--family", nargs="*", default=list(FALLING))
    parser.add_argument("--job", nargs="*", default=["sweep", "float"])
    parser.add_argument("--cause", nargs="*", default=ALL, choices=ALL)
    asked = parser.parse_args()
    for number in SIGNALS:  # nohup and a shell's background have a program ignore some
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    failed = 0
    for name, job in itertools.product(asked.family, asked.job):
        found = campaign(name, job, asked.cause, asked.draws, asked.seed)
        fast = sum(each["over"] >= EXTRA_SPEED for each in found)
        left = sum(each["away"] >= 0.1 or each["powered"] for each in found)
        worst = max(each["over"] for each in found)
        failed += fast + left
        causes = ", ".join(f"{number} {each}" for each, number in Counter(each["cause"] for each in found).items())
        print(
            f"{name} {job}: {len(found)} ends ({causes}), {fast} too fast, {left} not parked, "
            f"fastest {worst:+.2f} rad/s",
            flush=True,
        )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
