"""Kill the host of a drive that makes torque, again and again, family by family: does the joint do what its traits say?

`kill_drives.py [--tries 50] [--family damiao …] [--group 239.74.163.91]`; a try is one host process on a simulated
pendulum. A drive that falls must be without power, one that damps must damp, within the deadline and what this machine
was late. Exit status 0 where it was so in every try.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "armlink" / "drives"))
sys.path.insert(0, str(Path(__file__).parents[1] / "sim_bus"))
sys.path.insert(0, str(Path(__file__).parents[1] / "sim_bus" / "drives"))

import serving
from real_host import Host

from armlink.arm_file import Bus
from armlink.bus.open import open_bus
from armlink.drives.family import family
from armlink.drives.orders import Limits, Mode, Order, Power

DRIVES = serving.drives(kd=1.0)
DEADLINE, LONGEST = 0.25, 5.0


def bus_of(group: str, fd: bool) -> Bus:
    return Bus(interface="udp_multicast", channel=group, fd=fd)


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


def one_try(name: str, arm: serving.Served, group: str, number: int) -> float:
    """Seconds from the kill until the drive was as its traits say; infinite if it never was."""
    command = [sys.executable, __file__, "--push", name, "--group", group]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as host:
        assert host.stdout is not None
        if host.stdout.readline().strip() != "pushing" or not arm.drive.motor.powered:
            host.kill()
            return -1.0
        time.sleep(0.02 * (number % 10) / 10)
        os.kill(host.pid, signal.SIGKILL)
        struck = time.monotonic()
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
    asked = parser.parse_args()
    if asked.push:
        push(asked.push, asked.group)
        return 0
    failed = 0
    for name in asked.family:
        fd = name == "moteus"
        with serving.served(DRIVES[name], fd=fd, bus=bus_of(asked.group, fd), deadline=DEADLINE) as arm:
            times = [one_try(name, arm, asked.group, number) for number in range(asked.tries)]
        not_begun = sum(seconds < 0 for seconds in times)
        never = sum(seconds == float("inf") for seconds in times)
        worst = max([seconds for seconds in times if 0 <= seconds < float("inf")], default=0.0)
        failed += never + (not_begun == len(times))
        print(f"{name}: {len(times) - not_begun} kills, {never} not as the traits say, slowest {worst * 1e3:.0f} ms")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
