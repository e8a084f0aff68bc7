"""Watch a simulated arm at work: a torque sensor drifts, and the observer finds the joint and the size of the drift."""

from pathlib import Path

import numpy as np

from armlink.arm_file import load_arm
from armlink.link.link import Link
from calib.arm.kinematics import gcomp_arm
from calib.motion.trajectory import work_targets
from calib.observer.observer import Observer
from calib.observer.watch_loop import watch
from sim_bus.bus.lock_step import LockStepBus

arm = load_arm(str(Path(__file__).with_name("planar3.yaml")))
kinematics, bus = gcomp_arm(arm), LockStepBus(str(arm.path))
beta = np.array([2.1991, 0.0397, 0.8198, -0.0505, 0.0959, 0.0238])  # kg·m, as calibrate_and_identify.py prints them
observer = Observer.at_rest(kinematics, beta, np.diag(np.full(6, 0.002**2)), sigma=np.array([0.08, 0.03, 0.01]))  # N·m

with Link(arm, bus) as link:
    link.start()
    link.enable()
    limits = kinematics.lower, kinematics.upper, np.ones(3)  # rad, rad, rad/s
    work = work_targets(link.position_sent, *limits, link.period, np.random.default_rng(1))
    watch(link, observer, work, seconds=120.0)  # it learns first how far the arm is from its model
    bus.arm.drift("elbow", gain=1.03, offset=0.3)  # 3 % and 0.3 N·m
    history = watch(link, observer, work, seconds=90.0)
for event in history.events:
    size = "" if event.finding is None else f": gain {event.finding.gain:.4f}, offset {event.finding.offset:.3f} N·m"
    print(f"{event.t:6.1f} s  {event.kind} at {event.joint}{size}")
