"""Inertia about each joint, against the formula of a planar arm of two links."""

import numpy as np
import pytest

from gcomp.arm.load import joint_inertias, place_chain

MODEL = """
<mujoco><worldbody>
  <body><joint name="shoulder" axis="0 0 1"/><inertial pos="0.2 0 0" mass="2" diaginertia="0.01 0.02 0.03"/>
    <body pos="0.4 0 0"><joint name="elbow" axis="0 0 1" armature="0.05"/>
      <inertial pos="0.15 0 0" mass="1" diaginertia="0.01 0.01 0.02"/>
    </body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("mass", [0.0, 1.5])
def test_a_planar_arm_of_two_links(tmp_path, mass):
    (tmp_path / "arm.xml").write_text(MODEL)
    poses = np.array([[0.3, 0.0], [-1.0, 1.2], [2.0, np.pi]])
    found = joint_inertias(place_chain(tmp_path / "arm.xml"), poses, mass)
    second = 0.02 + 0.15**2
    first = 0.03 + 2 * 0.2**2 + second + 0.4**2 + 2 * 0.4 * 0.15 * np.cos(poses[:, 1]) + mass * 0.4**2
    np.testing.assert_allclose(found, np.stack([first, np.full(3, second + 0.05)], axis=1), atol=1e-12)
