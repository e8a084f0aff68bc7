"""The tool that an arm carries: in mass moments, in gravity records of before, on the command line, in the observer."""

import json

import numpy as np
import pytest
from fast_arm import FastArm

from armlink import cli
from armlink.arm_file import Tool, load_arm
from armlink.errors import BadInput
from calib.arm.kinematics import gcomp_arm, model_arm, parse_tool, tool_covariance, tool_moments, with_tool
from calib.daemon.observation.observation import ObserverFeed
from calib.observer.config import ObserverConfig
from calib.observer.observer import observer_of
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, parse_record, provenance
from gcomp.arm.mass_moments import base_parameters
from gcomp.gravity.torque import gravity_torque

GRIPPER = Tool(mass=0.8, centre=(0.02, -0.01, 0.1))
HAND = Tool(mass=1.5, centre=(0.0, 0.03, 0.12), mass_std=0.01, centre_std=0.002)
SARCOS = load_arm("sarcos")
ARM = gcomp_arm(SARCOS)
LINK = "<body pos='0.4 0 0'><joint axis='0 1 0'/><geom size='0.1' pos='0.2 0 0'/>"


def gravity(tool: Tool | None = None, beta: np.ndarray | None = None) -> GravityRecord:
    size = 2 * ARM.n
    return GravityRecord(
        **provenance(SARCOS, {"sweep": "ab" * 32}),
        names=ARM.names,
        beta=tuple((np.linspace(-1, 1, size) if beta is None else beta).tolist()),
        covariance=matrix(1e-6 * np.eye(size)),
        identifiable=(True,) * size,
        gravity=tuple(ARM.gravity.tolist()),
        tool=tool,
    )


def calibration() -> CalibrationRecord:
    joints = tuple(
        JointCalibration(name=name, gain=1.0, offset=0.0, position_gain=1.0, position_offset=0.0) for name in ARM.names
    )
    return CalibrationRecord(**provenance(SARCOS, {"sweep": "ab" * 32}), joints=joints)


def test_moments_are_those_of_a_body_on_the_last_link():
    mass = np.append(np.zeros(ARM.n - 1), GRIPPER.mass)
    moment = np.vstack([np.zeros((ARM.n - 1, 3)), GRIPPER.mass * np.array(GRIPPER.centre)])
    assert tool_moments(ARM, GRIPPER) == pytest.approx(base_parameters(ARM, mass, moment))
    draws = np.random.default_rng(0).normal(size=(4000, 4)) * [0.01, 0.002, 0.002, 0.002]
    made = [Tool(mass=HAND.mass + d[0], centre=tuple(np.array(HAND.centre) + d[1:])) for d in draws]
    spread = np.std([tool_moments(ARM, tool) for tool in made], axis=0)
    assert np.sqrt(np.diag(tool_covariance(ARM, HAND))) == pytest.approx(spread, rel=0.1, abs=1e-6)


def test_a_record_follows_the_exchange_of_a_tool():
    bare, with_hand = gravity(), gravity(HAND)
    exchanged = SARCOS.model_copy(update={"tool": GRIPPER})
    added = np.array(bare.carrying(exchanged).beta) - bare.beta
    assert added == pytest.approx(tool_moments(ARM, GRIPPER))
    swapped = np.array(with_hand.carrying(exchanged).beta) - with_hand.beta
    assert swapped == pytest.approx(tool_moments(ARM, GRIPPER) - tool_moments(ARM, HAND))
    taken_off = np.array(with_hand.carrying(SARCOS).beta) - with_hand.beta
    assert taken_off == pytest.approx(-tool_moments(ARM, HAND))
    assert np.array(with_hand.carrying(SARCOS).covariance)[-1, -1] > np.array(with_hand.covariance)[-1, -1]
    assert bare.carrying(SARCOS) is bare
    assert with_hand.carrying(SARCOS.model_copy(update={"tool": HAND})) is with_hand


def test_a_record_without_a_tool_is_stored_as_before_and_one_with_it_comes_back():
    assert "tool" not in json.loads(gravity().model_dump_json())
    kept = gravity(HAND)
    assert parse_record(json.loads(kept.model_dump_json()), "a test") == kept


def test_a_model_file_carries_it_too(tmp_path):
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{LINK}{LINK}</body></body></worldbody></mujoco>")
    (tmp_path / "arm.yaml").write_text(
        "name: two\nserial: '1'\nkinematics: {model: arm.xml}\ntool: {mass: 0.8, centre: [0.02, -0.01, 0.1]}\n"
    )
    arm_file = load_arm(str(tmp_path / "arm.yaml"))
    bare = model_arm(with_tool(arm_file, "0"))
    found = model_arm(arm_file)
    assert found.beta - bare.beta == pytest.approx(tool_moments(bare.arm, GRIPPER))
    assert found.mass[-1] - bare.mass[-1] == pytest.approx(0.8)


@pytest.mark.parametrize("place", ["arm.xml", "arm.yaml"])
def test_torque_takes_a_tool(tmp_path, capsys, place):
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{LINK}{LINK}</body></body></worldbody></mujoco>")
    (tmp_path / "arm.yaml").write_text("name: two\nserial: '1'\nkinematics: {model: arm.xml}\n")
    (tmp_path / "q.csv").write_text("q_1,q_2\n0.3,0.5\n")
    command = ["torque", str(tmp_path / place), "--q", str(tmp_path / "q.csv"), "--json", "-"]
    torques = []
    for tool in ([], ["--tool", "0.8,0.02,-0.01,0.1"], ["--tool", "0"]):
        assert cli.run([*command, *tool]) == 0
        torques.append(np.array(json.loads(capsys.readouterr().out)["torque"]))
    bare = model_arm(load_arm(str(tmp_path / "arm.yaml")))
    added = gravity_torque(bare.arm, tool_moments(bare.arm, GRIPPER), np.array([[0.3, 0.5]]))
    assert torques[1] - torques[0] == pytest.approx(added)
    assert torques[2] == pytest.approx(torques[0])


@pytest.mark.parametrize("text", ["", "1", "1,2,3", "-1,0,0,0", "nan,0,0,0", "1,0,0,inf", "a,0,0,0", "0.5;0;0;0"])
def test_a_tool_that_is_none_is_refused(text):
    with pytest.raises(BadInput, match="expected MASS,X,Y,Z"):
        parse_tool(text)


def test_an_observer_with_the_tool_takes_it_for_no_payload():
    fast = FastArm(seed=3)
    at = gravity(beta=fast.model).model_copy(update={"covariance": matrix(fast.covariance)})
    carries = SARCOS.model_copy(update={"tool": HAND})
    fast.carry(HAND.mass, np.array(HAND.centre))
    found = []
    for arm_file in (SARCOS, carries):
        observer = observer_of(fast.arm, calibration(), at.carrying(arm_file), fast.rated, ObserverConfig())
        found.append(
            [event.evidence["cause"] for event in fast.run(observer, 400.0, apply=False) if event.kind == "verdict"]
        )
    assert set(found[0]) == {"payload"}
    assert found[1] == []


def test_the_daemon_observes_anew_when_the_tool_of_its_arm_file_changes():
    at, sensors = gravity(), calibration()
    feed = ObserverFeed(SARCOS, sensors, at, ObserverConfig())
    assert feed.measures_against(sensors, at, SARCOS)
    assert not feed.measures_against(sensors, at, SARCOS.model_copy(update={"tool": HAND}))
