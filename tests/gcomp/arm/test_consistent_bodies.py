"""Bodies with given mass moments that can exist, in the model's own frames."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from gcomp.arm.consistent_bodies import closest_bodies, with_moments
from gcomp.arm.inertials import write_bodies
from gcomp.arm.load import compiled_spec, place_chain
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.torque import gravity_torque

MODELS = Path(__file__).parents[2] / "models"
WITHOUT_INERTIALS = """<robot name="bare"><link name="base"/><link name="one"/><link name="two"/>
<joint name="a" type="continuous"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/></joint>
<joint name="b" type="continuous"><parent link="one"/><child link="two"/><axis xyz="0 1 0"/>
<origin xyz="0.4 0 0"/></joint></robot>"""


FIXED = """<mujoco><worldbody><body name="one" pos="0 0 1" euler="0 30 0"><joint name="x" axis="1 0 0" pos="0 0.1 0"/>
<geom size="0.1" mass="1" pos="0.1 0.2 0.3"/><body name="arm" pos="0.3 0 0"><geom size="0.1" mass="2" pos="0 0.1 0"/>
<body name="two" pos="0.2 0 0"><joint name="z" axis="0 0.6 0.8" ref="20"/><geom type="box" size="0.1 0.2 0.3" mass="2"/>
</body></body></body></worldbody></mujoco>"""


@pytest.fixture(params=["ur10e.urdf", "bare.urdf", "fixed.xml"])
def path(request, tmp_path) -> Path:
    (tmp_path / "bare.urdf").write_text(WITHOUT_INERTIALS)
    (tmp_path / "fixed.xml").write_text(FIXED)
    return tmp_path / request.param if (tmp_path / request.param).is_file() else MODELS / request.param


@pytest.mark.parametrize("share", [0.0, 0.2, 3.0])
def test_the_model_then_has_these_moments_and_bodies_that_can_exist(path, share):
    placed = place_chain(path)
    arm, random = placed.arm.arm, np.random.default_rng(4)
    size = max(np.abs(placed.arm.beta).max(), 1.0)
    beta = placed.arm.beta + share * size * random.normal(0.0, 0.1, 2 * arm.n)
    spec, nominal = compiled_spec(path)
    write_bodies(spec, nominal, with_moments(placed, beta))
    model = spec.compile()
    data = mujoco.MjData(model)
    for q in random.uniform(-2, 2, (5, arm.n)):
        data.qpos[:] = placed.data.qpos
        data.qpos[model.jnt_qposadr[list(placed.joints)]] = q
        mujoco.mj_forward(model, data)
        found = data.qfrc_bias[model.jnt_dofadr[list(placed.joints)]]
        assert found == pytest.approx(gravity_torque(arm, beta, q), abs=1e-6 * size * 9.81)
    heavy = model.body_mass > 1e-9
    moments = model.body_inertia[heavy]
    assert np.all(2 * moments.max(axis=1) <= moments.sum(axis=1) * (1 + 1e-9))


def test_bodies_that_have_the_moments_stay_as_they_are(path):
    arm, random = place_chain(path).arm.arm, np.random.default_rng(5)
    root = random.normal(0.0, 0.2, (arm.n, 4, 4)) + np.eye(4)
    own = root @ np.swapaxes(root, 1, 2)
    beta = base_parameters(arm, own[:, 3, 3], own[:, :3, 3])
    assert closest_bodies(arm, own, beta) == pytest.approx(own, abs=1e-9)
    assert np.linalg.eigvalsh(closest_bodies(arm, own, 1.5 * beta)).min() > 0
