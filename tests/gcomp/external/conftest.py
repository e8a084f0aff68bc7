"""An arm of four joints whose torque is MuJoCo's, with friction, sensor errors and noise that no model knows."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from gcomp.arm.load import PlacedChain, bar_inertials, inertial_torque, place_chain
from gcomp.external.external_model import ArmPrior, ExternalModel, learn
from gcomp.external.filtered_rows import JOINT_COLUMNS, WAVES, Samples
from gcomp.gravity.torque import gravity_torque

RATE = 100.0
COULOMB, NOISE = np.array([0.6, 0.5, 0.3, 0.1]), 0.03
MODEL = """<mujoco><option gravity="1 -2 -9.5"/><worldbody><body name="a" pos="0.1 0 0.2" euler="10 20 30">
<joint name="j1" axis="0 0 1"/><inertial pos="0.1 0.02 0.05" mass="3" fullinertia="0.05 0.04 0.03 0.002 0.001 -0.003"/>
<body name="b" pos="0.3 0.1 0" euler="80 0 10"><joint name="j2" axis="0 1 0.2"/>
<inertial pos="0 0.1 0.05" mass="2" fullinertia="0.02 0.03 0.02 0.001 0 0.002"/>
<body name="c" pos="0 0.3 0.1"><joint name="j3" axis="1 0 0"/>
<inertial pos="0.05 0.1 0" mass="1.2" fullinertia="0.01 0.008 0.009 0 0.001 0"/>
<body name="d" pos="0.2 0 0" euler="0 40 0"><joint name="j4" axis="0 0.3 1"/>
<inertial pos="0 0.02 0.1" mass="0.7" fullinertia="0.003 0.004 0.002 0 0 0.0005"/></body></body></body></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="session")
def placed(tmp_path_factory: pytest.TempPathFactory) -> PlacedChain:
    path: Path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(MODEL)
    return place_chain(path)


@dataclass
class Work:
    """The arm swings, each joint in its own time, and stops now and then."""

    placed: PlacedChain
    seed: int
    seconds: float

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(self.seed)
        t = np.arange(0.0, self.seconds, 1 / RATE)
        n = self.placed.arm.arm.n
        pace, phase = self.random.uniform(0.4, 1.2, (2, n)), self.random.uniform(0, 6, (2, n))
        inner = t + np.sin(0.5 * t)  # its rate is 0 to 1.5: the arm comes to a stop
        rate, push = 1 + 0.5 * np.cos(0.5 * t), -0.25 * np.sin(0.5 * t)
        angle = inner[:, None, None] * pace + phase
        self.q = 0.6 * np.sin(angle).sum(axis=1)
        by_inner, twice = 0.6 * (pace * np.cos(angle)).sum(axis=1), -0.6 * (pace**2 * np.sin(angle)).sum(axis=1)
        self.v = by_inner * rate[:, None]
        self.a = twice * rate[:, None] ** 2 + by_inner * push[:, None]
        self.t = t

    def samples(self, external: np.ndarray | float = 0.0) -> Samples:
        arm = self.placed.arm
        torque = inertial_torque(self.placed, self.q, self.v, self.a) + gravity_torque(arm.arm, arm.beta, self.q)
        torque = 1.02 * torque + COULOMB * np.tanh(self.v / 0.01) + 0.2 * self.v + 0.1
        noise = NOISE * self.random.normal(size=torque.shape)
        return Samples(self.q, self.v, torque + noise - external, 0.0 * self.q)


@pytest.fixture(scope="session")
def prior(placed: PlacedChain) -> ArmPrior:
    """The right links with some doubt, and nothing known of friction."""
    n, links = placed.arm.arm.n, bar_inertials(placed)
    std = np.zeros(len(JOINT_COLUMNS) + WAVES)
    std[: len(JOINT_COLUMNS)] = 0.3
    std[len(JOINT_COLUMNS) :] = 0.05
    return ArmPrior(links, 1e-4 * np.eye(10 * n), np.zeros((n, len(std))), np.tile(std, (n, 1)), np.full(n, 0.1))


@pytest.fixture(scope="session")
def learned(placed: PlacedChain, prior: ArmPrior) -> ExternalModel:
    return learn(placed.arm.arm, prior, [Work(placed, 1, 90.0).samples()], RATE, np.full(placed.arm.arm.n, 10.0))
