"""Gravity-only identification of a seven-joint arm (offsets, covariance) against FIGAROH, one thread each."""

import warnings
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
from bench_gravity import pinocchio_model
from side_by_side import Case, seconds

from armlink.arm_file import load_arm
from calib.arm.kinematics import gcomp_arm
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.torque import gravity_torque
from gcomp.identify.global_fit import GlobalFit, identify_global
from gcomp.identify.readings import StaticReadings
from sim_bus.sim_section import sim_section

SAMPLES, SIGMA = 10_000, 0.05


def cases() -> list[Case]:
    """The case, after a check that both leave the same residual to one per cent."""
    arm_file = load_arm("sarcos")
    arm, links = gcomp_arm(arm_file), sim_section(arm_file).links
    mass = np.array([link.mass for link in links])
    com = np.array([link.com for link in links])
    rng = np.random.default_rng(0)
    q = rng.uniform(arm.lower, arm.upper, (SAMPLES, arm.n))
    torque = gravity_torque(arm, base_parameters(arm, mass, mass[:, None] * com), q) + rng.normal(size=arm.n)
    torque += SIGMA * rng.normal(size=torque.shape)
    model = pinocchio_model(arm, mass, com)

    readings = StaticReadings.of(q, torque, np.full(arm.n, SIGMA))

    def ours() -> GlobalFit:
        return identify_global(arm, readings, unknown=("offset", "beta"))

    def peer() -> float:
        return figaroh_residual(model, q, torque)

    rms = float(np.sqrt(np.mean(ours().residual ** 2)))
    assert abs(rms / peer() - 1) < 0.01
    peer_name = "FIGAROH build_regressor_basic, get_index_eliminate, double_decomposition, relative_stdev"
    return [Case("identify_10k_vs_figaroh", "ms", seconds(ours, 1, 1e3), seconds(peer, 1, 1e3), peer_name, runs=7)]


def figaroh_residual(model: pin.Model, q: np.ndarray, torque: np.ndarray) -> float:
    """FIGAROH's low-level fit of still samples: regressor, base parameters, estimate, deviations; residual [N·m]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from figaroh.identification.identification_tools import relative_stdev
        from figaroh.tools.qrdecomposition import QRDecomposer
        from figaroh.tools.regressor import build_regressor_basic, get_index_eliminate
    still = np.zeros_like(q)
    config = {"has_joint_offset": True, "is_joint_torques": True, "act_idxv": list(range(model.nv))}
    robot = SimpleNamespace(model=model, data=model.createData())
    full = build_regressor_basic(robot, q, still, still, config)
    names = dict.fromkeys(
        [f"{p}{i}" for i in range(model.nv) for p in range(10)] + [f"off{i}" for i in range(model.nv)]
    )
    dropped, kept = get_index_eliminate(full, names)
    reduced = np.delete(full, dropped, axis=1)
    measured = torque.T.ravel()
    base, _, _, phi = QRDecomposer().double_decomposition(measured, reduced, kept)
    relative_stdev(base, phi, measured)
    return float(np.sqrt(np.mean((measured - base @ phi) ** 2)))
