"""Kill, or stop, the host while a bias torque is on, again and again: is every joint safe within its deadline?

`kill_host.py [--tries 100] [--bus udp_multicast:239.74.163.77] [--stop] [--device cia402]`; a try is one host process;
`--device` is a stock one whose torque is a current, by default our own with its torque sensor. Exit status 0 where
every joint was in quick stop or without power within the deadline in every try.
"""

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))

from processes import ENABLED, SAFE, Ear, simulated, start_host, write_arm

RATE, DEADLINE = 50.0, 0.25
LONGEST = 10.0
"""A joint that is not safe by then never will be [s]."""


class NotBegunError(Exception):
    """The host did not get the joints enabled: the machine was too busy. The try is made again."""


def one_try(arm: Path, bus: str, ear: Ear, number: int) -> float:
    """Seconds from the signal until every joint was safe; infinite where one never was."""
    ear.forget()
    host = start_host(arm, bus)
    try:
        assert host.stdout is not None
        said = host.stdout.readline().strip()
        if said != "pushing" or not ear.listen(ENABLED, 10.0):
            raise NotBegunError(said)
        time.sleep(0.013 * (number % 20) / 20)  # so that the signal strikes anywhere in the cycle
        struck = time.monotonic()
        os.kill(host.pid, signal.SIGSTOP if number < 0 else signal.SIGKILL)
        safe = ear.listen(SAFE, LONGEST)
        return max(ear.when.values()) - struck if safe else float("inf")
    finally:
        host.kill()
        host.wait()


def tries(arm: Path, bus: str, ear: Ear, numbers: range) -> tuple[list[float], int]:
    """Seconds of each try, and how many tries had to be made again."""
    times, again = [], 0
    for number in numbers:
        while True:
            try:
                times.append(one_try(arm, bus, ear, number))
                print(f"{len(times)} of {len(numbers)}: {times[-1]:.3f} s", file=sys.stderr, flush=True)
                break
            except NotBegunError:
                again += 1
                if again > len(numbers):
                    raise
    return times, again


def main() -> int:
    """Run the campaign and say what it saw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=100)
    parser.add_argument("--bus", default="udp_multicast:239.74.163.77")
    parser.add_argument("--stop", action="store_true", help="SIGSTOP in place of SIGKILL")
    parser.add_argument("--device", default="", help="as in the key sim.device: cia402, epos4, nanotec, copley, sample")
    text = "what this script and the arm's process, which share the machine, may add to the deadline [s]"
    parser.add_argument("--slack", type=float, default=0.1, help=text)
    chosen = parser.parse_args()
    if chosen.bus.startswith("udp_multicast"):  # a port of one's own: all groups on one port hear each other
        os.environ["CAN_CONFIG"] = json.dumps({"port": 43200 + os.getpid() % 1000})
    with tempfile.TemporaryDirectory() as folder:
        arm, ear = write_arm(Path(folder), RATE, DEADLINE, chosen.device), Ear(chosen.bus)
        with simulated(arm, chosen.bus):
            numbers = range(-chosen.tries, 0) if chosen.stop else range(chosen.tries)
            times, again = tries(arm, chosen.bus, ear, numbers)
        ear.bus.shutdown()
    within = sum(seconds <= DEADLINE + chosen.slack for seconds in times)
    verb = "stopped" if chosen.stop else "killed"
    print(f"{verb}: every joint safe within {DEADLINE} s (+ {chosen.slack} s slack) in {within} of {len(times)}")
    middle = sorted(times)[len(times) // 2]
    print(f"median {middle:.3f} s, longest {max(times):.3f} s, on {chosen.bus}; {again} tries made again")
    return 0 if within == len(times) else 1


if __name__ == "__main__":
    sys.exit(main())
