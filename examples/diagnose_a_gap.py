"""Record a simulated arm whose elbow sensor reads 4 % high, and ask the diagnosis why it differs from its model."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from armlink.arm_file import load_arm
from armlink.link.link import Link
from armlink.recording.files import load_recording
from sim_bus.bus.lock_step import LockStepBus
from sim_gap.attribution.diagnose import diagnose
from sim_gap.experiment import collect

path = Path(__file__).with_name("planar3.yaml")  # its sim.effects belong to the simulated arm, not to the model
arm, bus = load_arm(str(path)), LockStepBus(str(path))
bus.arm.drift("elbow", gain=1.04, offset=0.0)

with TemporaryDirectory() as folder, Link(arm, bus) as link:
    link.start()
    link.enable()
    t = np.arange(0.0, 30.0, link.period)[:, None]
    collect(link, 1.2 * np.sin(2 * np.pi * np.array([0.07, 0.11, 0.17]) * t), Path(folder) / "run.mcap")
    recording = load_recording(Path(folder) / "run.mcap")

answer = diagnose(path, [recording])
print(answer.verdict)
for cause in answer.causes:
    values = {joint: [round(found.value, 3) for found in each.values()] for joint, each in cause.parameters.items()}
    print(f"{cause.effect}, confidence {cause.confidence:.2f}: {values}")
