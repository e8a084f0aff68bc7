"""Arms, sweeps and an independent gravity model (Pinocchio) for the tests of gcomp."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import base_parameters
from gcomp.arrays import Array
from gcomp.identify.parameters import Parameters
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict

DOWN, TILTED = (0.0, 0.0, -9.81), (9.81, 0.0, 0.0)
SARCOS_BETA = np.array(
    [
        *(0.1116, -0.9594, -0.1063, -4.6877, 0.1256, -1.0284, 0.0437),
        *(1.5219, 0.0376, 0.0871, -0.0217, 0.6686, 0.1132, -0.0594),
    ]
)
"""Table 2 of the paper, n_7y as its own Table 1 demands it (docs/theory.md, section 3) [kg·m]."""
SARCOS_MASS = np.array([8, 6, 5, 3.0264, 1.2, 0.73235, 3.90125])
SARCOS_MOMENTS = np.array(  # Table 1 of the paper from o_{i-1}, frame-i axes: docs/theory.md, section 3
    [
        [0.1116, 0.0485, -0.6305],
        [-0.1063, 0.3289, 0.5566],
        [0.1256, -1.7003, 0.8100],
        [0.0437, 0.2184, -0.0692],
        [0.0376, 0.2943, 0.1491],
        [-0.0217, -0.0620, 0.0149],
        [0.1132, -0.0594, -0.6835],
    ]
)


@dataclass(frozen=True)
class Built:
    """An arm whose inertials are known."""

    arm: Arm
    mass: Array
    first_moment: Array
    """In bar frames (n, 3)."""

    @property
    def beta(self) -> Array:
        return base_parameters(self.arm, self.mass, self.first_moment)


def make_sarcos(gravity: tuple[float, float, float] = TILTED) -> Arm:
    degrees = np.deg2rad
    return Arm(
        names=tuple(f"joint_{i}" for i in range(1, 8)),
        alpha=degrees([-90.0, -90, 90, 90, -90, 90, 0]),
        a=np.zeros(7),
        d=np.array([0, 0, -0.40, 0, -0.25, 0, -0.40]),
        theta_offset=np.zeros(7),
        gravity=np.array(gravity),
        lower=degrees([-50.0, -110, -95, 55, -100, -65, -60]),
        upper=degrees([110.0, 30, 95, 170, 100, 65, 60]),
    )


def bar_moments(arm: Arm, first_moment: Array) -> Array:
    """First moments (n, 3) given in Denavit-Hartenberg frames' axes, from o_{i-1}, in bar frames' axes: Rx(α_i)."""
    ca, sa = np.cos(arm.alpha), np.sin(arm.alpha)
    x, y, z = first_moment.T
    return np.stack([x, ca * y - sa * z, sa * y + ca * z], axis=1)


def make_random_arm(rng: np.random.Generator, n: int | None = None) -> Built:
    """Any twists (right angles, parallel axes and odd ones), lengths, base orientation and inertials."""
    n = n or int(rng.integers(2, 9))
    middle, half = rng.uniform(-1, 1, n), rng.uniform(1.0, 2.8, n)
    gravity = rng.normal(size=3)
    arm = Arm(
        names=tuple(f"j{i}" for i in range(1, n + 1)),
        alpha=np.where(rng.random(n) < 0.6, rng.choice([0, np.pi, np.pi / 2, -np.pi / 2], n), rng.uniform(-3, 3, n)),
        a=rng.uniform(-0.5, 0.5, n) * (rng.random(n) < 0.6),
        d=rng.uniform(-0.5, 0.5, n) * (rng.random(n) < 0.6),
        theta_offset=rng.uniform(-3, 3, n),
        gravity=9.81 * gravity / np.linalg.norm(gravity),
        lower=middle - half,
        upper=middle + half,
    )
    mass = rng.uniform(0.3, 6, n)
    return Built(arm, mass, mass[:, None] * rng.uniform(-0.2, 0.2, (n, 3)))


def to_pinocchio(built: Built) -> pin.Model:
    """The same arm for Pinocchio: its body frames are the bar frames."""
    model, parent, placement = pin.Model(), 0, pin.SE3.Identity()
    model.gravity.linear = built.arm.gravity.copy()
    for i in range(built.arm.n):
        parent = model.addJoint(parent, pin.JointModelRZ(), placement, built.arm.names[i])
        com = built.first_moment[i] / built.mass[i]
        model.appendBodyToJoint(parent, pin.Inertia(built.mass[i], com, np.eye(3)), pin.SE3.Identity())
        placement = pin.SE3(
            pin.utils.rotate("x", float(built.arm.alpha[i])), np.array([built.arm.a[i], 0, built.arm.d[i]])
        )
    return model


def pinocchio_torque(built: Built, q: Array) -> Array:
    model = to_pinocchio(built)
    data = model.createData()
    return np.array([pin.computeGeneralizedGravity(model, data, row + built.arm.theta_offset) for row in q])


def sweep_rows(
    arm: Arm, poses: int, steps: int, rng: np.random.Generator, *, sensors: str = "own"
) -> tuple[Array, Array]:
    """(Positions, NaN where a torque does not count): each joint swept between its stops, the others at random ones."""
    positions, marks = [], []
    for joint in range(arm.n):
        for _ in range(poses):
            rows = np.tile(np.where(rng.random(arm.n) < 0.5, arm.lower, arm.upper), (steps, 1))
            rows[:, joint] = np.linspace(arm.lower[joint], arm.upper[joint], steps)
            mark = np.full((steps, arm.n), 0.0 if sensors == "all" else np.nan)
            mark[:, joint] = 0.0
            positions.append(rows)
            marks.append(mark)
    return np.concatenate(positions), np.concatenate(marks)


def make_readings(
    arm: Arm,
    true: Parameters,
    positions: Array,
    marks: Array,
    *,
    loads: tuple[float, ...] = (0.0,),
    sigma: Array | float = 0.05,
    rng: np.random.Generator | None = None,
) -> StaticReadings:
    """What the sensors read at these true positions with each load; with noise where a generator is given."""
    phi = (positions - true.position_offset) / true.position_gain
    parts = [StaticReadings.of(phi, marks, sigma, load) for load in loads]
    rows = parts[0]
    for part in parts[1:]:
        rows = rows.joined(part)
    torque = predict(arm, true, rows) + rows.torque
    if rng is not None:
        torque = torque + rows.sigma * rng.normal(size=torque.shape)
    return StaticReadings(rows.position, torque, rows.sigma, rows.load)
