"""A simulated seven-joint arm over udp_multicast, paced at its rate: CPU share of the arm's process and of the host's.

    .venv/bin/python benchmarks/paced_multicast.py [SECONDS [RATE]]

`armlink sim sarcos` runs in its own process; a Link cycles it while holding. CPU time is measured, not elapsed time, so
that other processes affect the figures little. Prints JSON.
"""

import json
import os
import subprocess
import sys
import time

import numpy as np

from armlink.arm_file import load_arm
from armlink.link.link import Link
from armlink.link.types import Command

GROUP = "239.74.163.31"


def cpu_seconds(pid: int) -> float:
    """User and system time of a process [s]."""
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(seconds: float = 20.0, rate: float = 250.0) -> None:
    """Cycle for `seconds` and print the figures."""
    os.environ["CAN_CONFIG"] = json.dumps({"port": 44200 + os.getpid() % 1000})
    name = f"udp_multicast:{GROUP}"
    entry = "from armlink.cli import main; main()"
    arm_process = subprocess.Popen(
        [sys.executable, "-c", entry, "sim", "sarcos", "--bus", name], stderr=subprocess.PIPE, text=True
    )
    try:
        assert arm_process.stderr is not None
        arm_process.stderr.readline()
        arm = load_arm("sarcos")
        assert arm.link is not None
        arm = arm.model_copy(update={"link": arm.link.model_copy(update={"rate": rate, "deadline": 2.0})})
        with Link.open(arm, name) as link:
            link.start()
            command = Command.hold(link.enable().position)
            for _ in range(50):
                link.cycle(command)
            missed, count = link.stats.missed, int(seconds * rate)
            started, host, simulated = time.monotonic(), time.process_time(), cpu_seconds(arm_process.pid)
            ages, delays = np.empty(count), np.empty(count)
            for cycle in range(count):
                sample = link.cycle(command)
                ages[cycle], delays[cycle] = sample.age.max(), sample.delay
            elapsed = time.monotonic() - started
            answer = {
                "rate_hz": count / elapsed,
                "host_core_share": (time.process_time() - host) / elapsed,
                "arm_core_share": (cpu_seconds(arm_process.pid) - simulated) / elapsed,
                "missed_share": (link.stats.missed - missed) / count / link.n,
                "dropped": link._loop.dropped,
                "oldest_reading_ms": ages.max() * 1e3,
                "sync_to_readings_ms": dict(zip(("p50", "p99"), np.percentile(delays, (50, 99)) * 1e3, strict=True)),
            }
            link.disable()
    finally:
        arm_process.terminate()
        arm_process.wait()
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main(*(float(each) for each in sys.argv[1:]))
