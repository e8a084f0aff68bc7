"""armlink torque: gravity torque at poses, from a model's inertials against Pinocchio, or from a record."""

import json
from datetime import UTC, datetime

import numpy as np
import pinocchio as pin
import pytest

from armlink import cli
from armlink.arm_file import load_arm
from calib.arm.kinematics import gcomp_arm
from calib.records.records import GravityRecord, provenance
from calib.records.store import RecordStore
from gcomp.gravity.torque import gravity_torque

URDF = """
<robot name="three">
  <link name="base"/>
  {links}
</robot>
"""
LINK = """
<link name="link_{i}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>
  <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="joint_{i}" type="revolute"><parent link="{parent}"/><child link="link_{i}"/><axis xyz="{axis}"/>
  <origin xyz="{xyz}" rpy="{rpy}"/><limit lower="-2" upper="2" effort="9" velocity="9"/></joint>
"""
SHAPES = [
    {"com": "0.02 0.1 -0.05", "mass": 3.0, "axis": "0 0 1", "xyz": "0 0 0.3", "rpy": "0.3 0.1 0"},
    {"com": "0.1 0 0.02", "mass": 2.0, "axis": "0 1 0", "xyz": "0.1 0 0.2", "rpy": "0 0 0.7"},
    {"com": "0 0.03 0.15", "mass": 1.0, "axis": "0.6 0 0.8", "xyz": "0 0.2 0.3", "rpy": "1.2 0 0.2"},
]


@pytest.fixture
def urdf(tmp_path):
    parents = ["base", "link_1", "link_2"]
    links = "".join(LINK.format(i=i + 1, parent=parents[i], **shape) for i, shape in enumerate(SHAPES))
    path = tmp_path / "three.urdf"
    path.write_text(URDF.format(links=links))
    return path


@pytest.fixture
def poses(tmp_path):
    q = np.random.default_rng(4).uniform(-1.5, 1.5, (20, 7))
    path = tmp_path / "poses.csv"
    rows = [",".join(f"{value:.17g}" for value in (index, *row)) for index, row in enumerate(q)]
    path.write_text("\n".join(["t," + ",".join(f"q_{i}" for i in range(1, 8)), *rows]) + "\n")
    return path, q


def answer_of(capsys, *arguments):
    assert cli.run(["torque", *map(str, arguments), "--json", "-"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_model_s_torque_equals_pinocchio_s(urdf, poses, capsys):
    path, q = poses
    answer = answer_of(capsys, urdf, "--q", path)
    model = pin.buildModelFromUrdf(str(urdf))
    data = model.createData()
    expected = [pin.computeGeneralizedGravity(model, data, row[:3].copy()) for row in q]
    np.testing.assert_allclose(answer["torque"], expected, atol=1e-8)
    assert answer["joints"] == ["joint_1", "joint_2", "joint_3"]


def test_an_arm_file_s_torque_is_its_current_record_s(tmp_path, poses, capsys):
    path, q = poses
    arm = load_arm("sarcos")
    beta = np.random.default_rng(1).normal(size=14)
    record = GravityRecord(
        **provenance(arm, created=datetime(2026, 1, 1, tzinfo=UTC)),
        names=arm.joint_names,
        beta=tuple(beta),
        covariance=tuple(tuple(row) for row in np.zeros((14, 14))),
        identifiable=(True,) * 14,
        gravity=arm.kinematics.gravity,
    )
    store = tmp_path / "store.db"
    kept = RecordStore(str(store)).put(record, arm, by="test", reason="test")
    expected = gravity_torque(gcomp_arm(arm), beta, q)
    for more in ([], ["--record", kept]):
        answer = answer_of(capsys, "sarcos", "--q", path, "--store", store, *more)
        np.testing.assert_allclose(answer["torque"], expected, rtol=1e-12)
        assert kept in answer["source"]


def test_without_inertials_or_record_there_is_no_answer(tmp_path, poses, capsys):
    assert cli.run(["torque", "sarcos", "--q", str(poses[0]), "--store", str(tmp_path / "store.db")]) == 1
    way = "sweep the arm, then identify: armlink sweep sarcos --out unloaded"
    assert f"there is no gravity record yet: {way}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("q_1,q_2\n0,0\n", ["column q_3 is missing"]),
        ("q_1,q_2,q_3\n", ["no row of values"]),
        ("q_1,q_2,q_3\n0,0,0\n0,wide,0\n", ["row 2", "q_2", "wide"]),
        ("q_1,q_2,q_3\n0,nan,0\n", ["row 1", "q_2", "nan"]),
        ("q_1,q_2,q_3\n0,0\n", ["row 1", "3 columns"]),
        ("", ["column q_1 is missing"]),
    ],
)
def test_bad_poses_are_one_line(urdf, tmp_path, capsys, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert cli.run(["torque", str(urdf), "--q", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    for word in words:
        assert word in err


@pytest.mark.parametrize(("arm", "word"), [("gone.urdf", "gone.urdf"), ("broken.xml", "broken.xml")])
def test_a_bad_model_is_one_line(poses, tmp_path, monkeypatch, capsys, arm, word):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
    assert cli.run(["torque", arm, "--q", str(poses[0])]) == 2
    err = capsys.readouterr().err
    assert word in err
    assert err.count("\n") == 1
