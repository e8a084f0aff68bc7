"""Kill the host of a drive that makes torque, again and again, family by family: does the joint do what its traits say?

`kill_drives.py [--tries 50] [--stop] [--family damiao …] [--group 239.74.163.91]`; a try is one host process on a
simulated pendulum, and `--stop` stops it (SIGSTOP) in place of killing it. A drive that falls must be without power,
one that damps must damp, within the deadline and what this machine was late. A drive without a time-out must be held
where it stood by the keeper of its host. Exit status 0 where it was so in every try.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "drives"))
sys.path.insert(0, str(Path(__file__).parents[1] / "sim_bus"))
sys.path.insert(0, str(Path(__file__).parents[1] / "sim_bus" / "drives"))

import serving
from real_host import Host

from armlink.arm_file import Bus
from armlink.bus.open import open_bus
from armlink.drives.family import family
from armlink.drives.orders import Limits, Mode, Order, Power
from armlink.link.link import Link
from armlink.link.types import Command
from armlink.loop.realtime import prepare
from sim_bus.drives.myactuator import SPEED_LOOP

MOST_TORQUE, MOST_SPEED = 5.0, 3.0
"""Limits of a joint with a keeper [N·m] and [rad/s]: a pendulum swings to no more."""
KEPT: dict[str, tuple[dict[str, object], Callable[[Any], bool]]] = {
    "piper": (
        {"family": "piper", "joint": 2, "firmware": "S-V1.6-3", "kp": 40, "kd": 1},
        lambda drive: drive.enabled and drive._law[0] > 0,
    ),
    "cubemars without a time-out": (
        {"family": "cubemars", "id": 2, "model": "AK80-9", "kp": 40, "kd": 1},
        lambda drive: drive.motor_mode and drive.command.kp > 0,
    ),
    "myactuator without a time-out": (
        {"family": "myactuator", "id": 1, "model": "X8-25"},
        lambda drive: drive.mode == SPEED_LOOP and drive.motor.powered,
    ),
}
"""Drives that keep on with their last command, and whether one is held by what a keeper sent."""
DRIVES = serving.drives(kd=1.0) | {name: drive for name, (drive, _) in KEPT.items()}
DEADLINE, LONGEST = 0.25, 5.0
HELD_SECONDS, HELD = 1.0, 0.2
"""A joint that is held stays within HELD [rad] of where it stood for so long [s]: its torque is that of a push."""
RATE, CYCLES_BEFORE = 100.0, 30


def bus_of(group: str, fd: bool) -> Bus:
    return Bus(interface="udp_multicast", channel=group, fd=fd)


def push_kept(name: str, group: str) -> None:
    """The host of a drive without a time-out: torque until it is killed, and a keeper beside it."""
    arm = serving.pendulum(KEPT[name][0], bus={"interface": "udp_multicast"}, deadline=DEADLINE, rate=RATE, keeper=True)
    prepare()
    section = arm.require_link()
    joint = section.joints[0].model_copy(update={"max_torque": MOST_TORQUE, "max_velocity": MOST_SPEED})
    arm = arm.model_copy(update={"link": section.model_copy(update={"joints": (joint,)})})
    with Link.open(arm, f"udp_multicast:{group}") as link:
        link.start()
        command = Command.hold(link.enable().position)
        command.mode[0], command.torque[0] = Mode.TORQUE, 0.3
        for cycle in count():
            link.cycle(command)
            if cycle == CYCLES_BEFORE:
                print("pushing", flush=True)


def push(name: str, group: str) -> None:
    """The host: torque until it is killed."""
    arm = serving.pendulum(DRIVES[name], bus={"interface": "udp_multicast", "fd": name == "moteus"}, deadline=DEADLINE)
    drives = family(name).build(arm, arm.require_link().joints)
    bus = open_bus(None, bus_of(group, name == "moteus"))
    host = Host(bus.open_port(), drives)
    drives.set_up(host, [Limits(5.0, 200.0, 10.0, -6.0, 6.0, DEADLINE, 0.02)])

    def order(walk: bool = False) -> Order:
        return Order(Power.ON, walk, Mode.TORQUE, host.latest.get(0, 0.0), 0.0, 0.3, 0.0, 0.0)

    assert host.until(lambda: drives.power(0) is Power.ON, lambda: order(walk=True))
    host.until(lambda: False, order, 0.2)
    print("pushing", flush=True)
    host.until(lambda: False, order, 3600.0)


def at_rest(arm: serving.Served) -> None:
    """As after the hand that supported it and switched its power off and on."""
    arm.drive.reboot()
    arm.arm.plant.place(0, 0.0)


def one_try(name: str, arm: serving.Served, group: str, number: int, how: signal.Signals) -> float:
    """Seconds from the kill until the drive was as its traits say; infinite if it never was."""
    if name in KEPT:
        arm.do(lambda: at_rest(arm))
    command = [sys.executable, __file__, "--push", name, "--group", group]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as host:
        assert host.stdout is not None
        if host.stdout.readline().strip() != "pushing" or not arm.drive.motor.powered:
            host.kill()
            return -1.0
        time.sleep(0.02 * (number % 10) / 10)
        os.kill(host.pid, how)
        struck, stood = time.monotonic(), arm.angle
        if name in KEPT:
            done = serving.wait_for(lambda: KEPT[name][1](arm.drive), LONGEST)
            took, end = time.monotonic() - struck, time.monotonic() + HELD_SECONDS
            furthest = 0.0
            while time.monotonic() < end:
                furthest = max(furthest, abs(arm.angle - stood))
                time.sleep(0.01)
            host.kill()
            return took if done and furthest < HELD else float("inf")
        described = serving.pendulum(DRIVES[name], bus={"interface": "virtual", "fd": name == "moteus"})
        falls = family(name).build(described, described.require_link().joints).traits(0).silence == "falls"
        done = serving.wait_for(lambda: not arm.drive.motor.powered if falls else arm.drive.mode == 11, LONGEST)
        return time.monotonic() - struck if done else float("inf")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=50)
    parser.add_argument("--family", nargs="*", default=list(DRIVES))
    parser.add_argument("--group", default="239.74.163.91")
    parser.add_argument("--push", default="")
    parser.add_argument("--stop", action="store_true", help="SIGSTOP in place of SIGKILL")
    asked = parser.parse_args()
    if asked.push:
        (push_kept if asked.push in KEPT else push)(asked.push, asked.group)
        return 0
    # a port of one's own: all groups on one port hear each other
    os.environ["CAN_CONFIG"] = json.dumps({"port": 43200 + os.getpid() % 1000})
    failed = 0
    for name in asked.family:
        fd = name == "moteus"
        with serving.served(DRIVES[name], fd=fd, bus=bus_of(asked.group, fd), deadline=DEADLINE) as arm:
            how = signal.SIGSTOP if asked.stop else signal.SIGKILL
            times = []
            for number in range(asked.tries):
                times.append(one_try(name, arm, asked.group, number, how))
                print(f"{name}: {number + 1} of {asked.tries}: {times[-1]:.3f} s", file=sys.stderr, flush=True)
        not_begun = sum(seconds < 0 for seconds in times)
        never = sum(seconds == float("inf") for seconds in times)
        worst = max([seconds for seconds in times if 0 <= seconds < float("inf")], default=0.0)
        failed += never + (not_begun == len(times))
        print(f"{name}: {len(times) - not_begun} kills, {never} not as the traits say, slowest {worst * 1e3:.0f} ms")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
