"""Axes and links of a drawing against MuJoCo's kinematics and gcomp's bar frames."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armlink.arm_file import load_arm, parse_arm
from calib.arm.kinematics import gcomp_arm
from calib.daemon.service_view import drawn_arm
from calib.daemon.view import DrawnArm
from gcomp.arm.arm import bar_frames
from gcomp.arm.load import place_chain

MODELS = Path(__file__).parents[2] / "models"


def moved(drawn: DrawnArm, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes, points and the tip at joint positions q."""
    turn, shift = Rotation.identity(), np.zeros(3)
    axes, points = [], []
    for joint, at in zip(drawn.joints, q, strict=True):
        axis, point, angle = np.array(joint.axis), np.array(joint.point), at - joint.reference
        axes.append(turn.apply(axis))
        points.append(turn.apply(point) + shift)
        own = Rotation.from_rotvec(angle * axis)
        turn, shift = turn * own, turn.apply(point - own.apply(point)) + shift
    return np.array(axes), np.array(points), turn.apply(drawn.joints[-1].link[-1]) + shift


@pytest.mark.parametrize(("name", "tip"), [("arm4.urdf", "l4"), ("own.xml", "palm"), ("ur10e.urdf", None)])
def test_a_models_axes_are_where_mujoco_has_them(name: str, tip: str | None) -> None:
    path = MODELS / name
    placed = place_chain(path, tip=tip)
    kinematics = {"model": str(path)} | ({"tip": tip} if tip else {})
    drawn = drawn_arm(parse_arm({"name": "a", "kinematics": kinematics}, path.with_suffix(".yaml")))
    q = np.random.default_rng(3).uniform(-1.0, 1.0, len(drawn.joints))
    model, data = placed.model, mujoco.MjData(placed.model)
    chain = [model.joint(joint).id for joint in placed.arm.arm.names]
    data.qpos[model.jnt_qposadr[chain]] = q
    mujoco.mj_kinematics(model, data)
    axes, points, tip_at = moved(drawn, q)
    np.testing.assert_allclose(axes, data.xaxis[chain], atol=1e-9)
    np.testing.assert_allclose(points, data.xanchor[chain], atol=1e-9)
    assert len(drawn.joints) == len(chain)
    assert np.linalg.norm(tip_at - points[-1]) > 0.01
    np.testing.assert_allclose(drawn.up, [0.0, 0.0, 1.0])


def test_denavit_hartenberg_rows_turn_as_gcomp_turns_them() -> None:
    arm_file = load_arm("sarcos")
    arm, drawn = gcomp_arm(arm_file), drawn_arm(arm_file)
    q = np.random.default_rng(4).uniform(-1.0, 1.0, arm.n)
    axes, _, _ = moved(drawn, q)
    np.testing.assert_allclose(axes, bar_frames(arm, q[None]).rotation[0, :, :, 2], atol=1e-12)
    np.testing.assert_allclose(drawn.up, [-1.0, 0.0, 0.0])
    lengths = [
        float(np.linalg.norm(np.diff(link, axis=0), axis=1).sum()) for link in (joint.link for joint in drawn.joints)
    ]
    np.testing.assert_allclose(lengths, np.abs(arm.a) + np.abs(arm.d))
    for k in range(arm.n - 1):
        np.testing.assert_allclose(drawn.joints[k].link[-1], drawn.joints[k + 1].link[0])


def test_a_last_link_without_length_gets_a_stub() -> None:
    rows = [{"name": name, "a": a, "lower": -1.0, "upper": 1.0} for name, a in (("one", 0.3), ("two", 0.0))]
    drawn = drawn_arm(parse_arm({"name": "a", "kinematics": {"joints": rows}}, Path("a.yaml")))
    np.testing.assert_allclose(drawn.joints[1].link, [[0.3, 0.0, 0.0], [0.3, 0.0, 0.08]])
