"""Chosen stops against random ones and all joints at once; prints the table of docs/appendix/identification.md."""

import numpy as np
from rich.console import Console
from rich.table import Table

from armlink.arm_file import load_arm
from calib.arm.kinematics import gcomp_arm
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import base_parameters
from gcomp.design.sweep_design import JointSweep, choose_sweeps, readings_of, stop_combinations
from gcomp.gravity.torque import torque_covariance
from gcomp.identify.global_fit import Prediction, predict_covariance
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from sim_bus.sim_section import sim_section

SIGMA = np.array([0.15, 0.15, 0.08, 0.06, 0.03, 0.03, 0.02])
STEPS, RANDOM_DESIGNS, LOADS = 25, 100, (0.0, 2.0)
GAINS_KNOWN = ("offset", "beta")
CALIBRATION = ("gain", "offset", "position_offset", "beta", "rho")


def main() -> None:
    """Predicted torque error of each joint, RMS over 400 poses of the joint range."""
    arm_file = load_arm("sarcos")
    arm, links = gcomp_arm(arm_file), sim_section(arm_file).links
    mass = np.array([link.mass for link in links])
    beta = base_parameters(arm, mass, mass[:, None] * np.array([link.com for link in links]))
    guess = Parameters.nominal(arm.n, beta=beta, rho=[0.05, -0.03, 0.1])
    table = Table("unknown", "sweeps a joint", "design", *(f"{name} [mN·m]" for name in arm.names))
    for unknown, loads, words in ((GAINS_KNOWN, (0.0,), "β, o"), (CALIBRATION, LOADS, "k, o, θ0, β, ρ")):
        for poses in (2, 4):
            for design, error in compare(arm, guess, unknown, loads, poses).items():
                table.add_row(words, str(poses), design, *(f"{1e3 * value:.1f}" for value in error))
    Console(width=160).print(table)


def compare(
    arm: Arm, guess: Parameters, unknown: tuple[str, ...], loads: tuple[float, ...], poses: int
) -> dict[str, np.ndarray]:
    """Torque errors (n,) by design."""
    rng = np.random.default_rng(0)
    checked = rng.uniform(arm.lower, arm.upper, (400, arm.n))

    def error(prediction: Prediction) -> np.ndarray:
        at = [i for i, name in enumerate(prediction.names) if name.startswith("mass_moment")]
        covariance = torque_covariance(arm, prediction.covariance[np.ix_(at, at)], checked)
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))

    def at_once(rows: int) -> np.ndarray:
        positions = np.tile(rng.uniform(arm.lower, arm.upper, (rows, arm.n)), (len(loads), 1))
        readings = StaticReadings.of(positions, np.zeros_like(positions), SIGMA, np.repeat(loads, rows))
        return error(predict_covariance(arm, readings, guess, unknown=unknown))

    def at_random() -> np.ndarray:
        sweeps = [
            JointSweep(joint, pose, np.linspace(arm.lower[joint], arm.upper[joint], STEPS))
            for joint in range(arm.n)
            for pose in rng.permutation(stop_combinations(arm, joint))[:poses]
        ]
        return error(predict_covariance(arm, readings_of(arm, sweeps, SIGMA, loads), guess, unknown=unknown))

    chosen = {
        f"chosen, {criterion}-optimal": error(
            choose_sweeps(
                arm, guess, sigma=SIGMA, unknown=unknown, poses=poses, steps=STEPS, loads=loads, criterion=criterion
            ).prediction
        )
        for criterion in ("D", "A")
    }
    return {
        **chosen,
        "random stops, median of 100": np.median([at_random() for _ in range(RANDOM_DESIGNS)], axis=0),
        "all joints at once, as many readings": at_once(STEPS * poses),
        "all joints at once, as many poses": at_once(STEPS * poses * arm.n),
    }


if __name__ == "__main__":
    main()
