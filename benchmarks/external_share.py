"""Share of a core that external torque, wrench and contacts take at 250 Hz with seven joints.

    .venv/bin/python benchmarks/external_share.py [--part 10]

Samples come in parts as from a bus, and go the way of the live command and of the daemon; there are 25 rows a second.
Prints JSON; times are the 5th, 50th and 99th percentile of parts that end with the sample of a row, from the call with
this sample to the row's value and wrench, by the clock and of the processor.
"""

import argparse
import json
import time

import numpy as np

from armlink.arm_file import load_arm
from calib.arm.kinematics import StatedModel, gcomp_arm
from calib.external.arm_model import MOTOR, ArmListener, ArmRecords, prior_of_model
from calib.external.listening import Learned, LiveExternal, WrenchFrame
from gcomp.external.external_model import ROWS_RATE, from_records, stride_of
from gcomp.gravity.torque import gravity_torque
from sim_bus.sim_section import sim_section

RATE = 250.0
SECONDS = 40.0
FIRST = 11
"""Samples until the first row; one every ten then."""


def main() -> None:
    """Print CPU time a sample, share of a core, and times from a row's sample to its value."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", type=int, default=10, help="samples at a time")
    part = parser.parse_args().part
    arm_file = load_arm("sarcos")
    arm = gcomp_arm(arm_file)
    links = np.zeros((arm.n, 10))
    for row, link in zip(links, sim_section(arm_file).links, strict=True):
        row[0], row[1:4] = link.mass, link.mass * np.array(link.com)
        row[[4, 7, 9]] = 0.02 * link.mass
    scale = np.full(arm.n, 20.0)
    model = from_records(arm, prior_of_model(arm, links, MOTOR, scale), scale)
    t = np.arange(0.0, SECONDS, 1 / RATE)
    pace = np.linspace(0.4, 1.1, arm.n)
    q = 0.4 * np.sin(t[:, None] * pace)
    v = 0.4 * pace * np.cos(t[:, None] * pace)
    torque = gravity_torque(arm, model.links.reshape(arm.n, 10)[:, 1:3].ravel(), q)
    records = ArmRecords(StatedModel(arm, None, None, None, arm_file))
    frame = WrenchFrame(arm.n - 1, np.array([0.0, 0.0, 0.1]))
    live = LiveExternal(Learned(ArmListener(model, records, "motor_torque", RATE, None), frame, 1.0))
    waits, newest = [], live.row
    begun = time.process_time()
    for begin in [0, *range(FIRST, len(t), part)]:
        rows = slice(begin, FIRST if begin == 0 else begin + part)
        at, cpu = time.perf_counter(), time.process_time()
        live.take(t[rows], q[rows], v[rows], torque[rows], None)
        if live.row is newest:
            continue
        live.wrench()
        newest = live.row
        waits.append((time.perf_counter() - at, time.process_time() - cpu))
    spent = time.process_time() - begun
    wall, own = (1e3 * np.percentile([each[k] for each in waits], [5, 50, 99]) for k in (0, 1))
    print(
        json.dumps({
            "joints": arm.n, "rate_hz": RATE, "rows_hz": ROWS_RATE, "part": part, "stride": stride_of(RATE),
            "cpu_ms_a_sample": round(1e3 * spent / len(t), 4), "share_of_core": round(spent / SECONDS, 4),
            "value_after_ms": [round(x, 2) for x in wall], "of_cpu_ms": [round(x, 2) for x in own],
        })
    )  # fmt: skip


if __name__ == "__main__":
    main()
