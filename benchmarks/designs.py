"""Chosen stops against random ones and all joints at once; prints the table of docs/appendix/identification.md."""

import numpy as np
from rich.console import Console
from rich.table import Table

from armlink.arm_file import load_arm
from calib.arm.kinematics import gcomp_arm
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import base_parameters
from gcomp.design.selection import select, stop_combinations, sufficient_levers, sweep_jacobian
from gcomp.gravity.torque import gravity_levers, torque_covariance
from gcomp.identify.global_fit import Precision, predict_covariance
from gcomp.identify.parameters import Parameters, free_mask, natural_units
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import expected_readings
from sim_bus.sim_section import sim_section

SIGMA = np.array([0.15, 0.15, 0.08, 0.06, 0.03, 0.03, 0.02])
STEPS, RANDOM_DESIGNS, LOADS = 25, 100, (0.0, 2.0)
SKETCH_STEPS = 7
"""Steps by which a candidate sweep is judged: more than a sinusoid's three unknowns (docs/theory.md, section 5.3)."""
Sweep = tuple[int, np.ndarray]
"""The joint that moves from stop to stop, and the pose (n,) in which the others rest [rad]."""
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

    def error(prediction: Precision) -> np.ndarray:
        at = [i for i, name in enumerate(prediction.names) if name.startswith("mass_moment")]
        covariance = torque_covariance(arm, prediction.covariance[np.ix_(at, at)], checked)
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))

    def at_once(rows: int) -> np.ndarray:
        positions = np.tile(rng.uniform(arm.lower, arm.upper, (rows, arm.n)), (len(loads), 1))
        readings = StaticReadings.of(positions, np.zeros_like(positions), SIGMA, np.repeat(loads, rows))
        return error(predict_covariance(arm, readings, guess, unknown=unknown))

    def of_sweeps(sweeps: list[Sweep]) -> np.ndarray:
        return error(predict_covariance(arm, readings_of(arm, sweeps, loads), guess, unknown=unknown))

    def at_random() -> np.ndarray:
        stops = [(joint, rng.permutation(stop_combinations(arm, joint))[:poses]) for joint in range(arm.n)]
        return of_sweeps([(joint, pose) for joint, each in stops for pose in each])

    return {
        "chosen, D-optimal": of_sweeps(chosen_sweeps(arm, guess, unknown, loads, poses)),
        "random stops, median of 100": np.median([at_random() for _ in range(RANDOM_DESIGNS)], axis=0),
        "all joints at once, as many readings": at_once(STEPS * poses),
        "all joints at once, as many poses": at_once(STEPS * poses * arm.n),
    }


def positions_of(arm: Arm, sweep: Sweep, steps: int) -> np.ndarray:
    joint, pose = sweep
    rows = np.tile(pose, (steps, 1))
    rows[:, joint] = np.linspace(arm.lower[joint], arm.upper[joint], steps)
    return rows


def readings_of(arm: Arm, sweeps: list[Sweep], loads: tuple[float, ...], steps: int = STEPS) -> StaticReadings:
    """Readings of these sweeps, repeated with each load; only the swept joint's torque counts and is 0."""
    positions = np.concatenate([positions_of(arm, sweep, steps) for sweep in sweeps])
    torque = np.full(positions.shape, np.nan)
    torque[np.arange(len(torque)), np.repeat([joint for joint, _ in sweeps], steps)] = 0.0
    rows = [np.tile(each, (len(loads), 1)) for each in (positions, torque)]
    return StaticReadings.of(*rows, SIGMA, np.repeat(loads, len(positions)))


def chosen_sweeps(
    arm: Arm, guess: Parameters, unknown: tuple[str, ...], loads: tuple[float, ...], poses: int
) -> list[Sweep]:
    """`poses` sweeps of every joint, stops chosen together."""
    candidates = []
    for joint in reversed(range(arm.n)):  # tip first
        stops = stop_combinations(arm, joint)
        lever = gravity_levers(arm, stops)[:, joint] / np.linalg.norm(arm.gravity)
        candidates.append([(joint, pose) for pose in stops[sufficient_levers(lever)]])
    free = free_mask(arm.n, unknown)
    everything = readings_of(arm, [sweep for each in candidates for sweep in each], (0.0,), SKETCH_STEPS)
    unit = natural_units(arm, expected_readings(arm, guess, everything), guess)[free]
    rows = []
    for each in candidates:
        positions = np.stack([positions_of(arm, sweep, SKETCH_STEPS) for sweep in each])
        jacobian = sweep_jacobian(arm, guess, each[0][0], positions, SIGMA, free, loads)
        rows.append(jacobian[None] * np.sqrt(STEPS / SKETCH_STEPS))
    picks = select(rows, np.diag(unit**-2.0)[None], [poses] * arm.n)
    return [each[pick] for each, of_joint in zip(candidates, picks, strict=True) for pick in of_joint]


if __name__ == "__main__":
    main()
