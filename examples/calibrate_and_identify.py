"""Calibrate the torque sensors of a simulated arm and identify its gravity model: two passes of sweeps, two fits."""

from pathlib import Path
from tempfile import TemporaryDirectory

from armlink.arm_file import load_arm
from armlink.link.link import Link
from calib.fit.gravity_fit import identify_gravity
from calib.fit.sensor_fit import fit_sensors
from calib.sweep.run import run_sweep
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

arm = load_arm(str(Path(__file__).with_name("planar3.yaml")))
simulated = SimulatedArm(arm, Truth.draw(arm, seed=1), seed=1)  # hidden gains and offsets, for the fit to find
mass = 4.0  # kg, known to 0.1 %: without it, gravity alone gives the gains up to a common factor

with TemporaryDirectory() as folder, Link(arm, LockStepBus(arm=simulated)) as link:
    link.start()
    link.enable()
    unloaded = run_sweep(link, arm, Path(folder) / "unloaded")
    simulated.attach_mass(mass)
    loaded = run_sweep(link, arm, Path(folder) / "loaded", reference_mass=mass)

fit = fit_sensors(arm, [unloaded, loaded])
for j, name in enumerate(fit.names):
    low, high = fit.ci95("gain")[j]
    print(f"{name}: torque gain {low:.4f} to {high:.4f} (95 %), true {simulated.truth.gain[j]:.4f}")
print("mass moments [kg·m], x and y of each joint:", identify_gravity(arm, [unloaded, loaded], fit).beta.round(4))
