"""Messages of joint states as a bus: what is late, missing or strange is left out and said, and nothing can be sent."""

import ast
import inspect
import math
from pathlib import Path

import numpy as np
import pytest
from fake_joints import FakeClock

from armlink.arm_file import load_arm, parse_arm
from armlink.bus.listening import joint_messages
from armlink.bus.listening.joint_messages import JointStateMessage, ListeningBus, SenderClock, message_names
from armlink.errors import ArmlinkError, BadInput
from armlink.link.link import Link
from armlink.link.listener import Listener
from armlink.monitor.monitor import Monitor
from armlink.recording.recorder import Recorder


class Script:
    """Messages that come at their times, by a clock that stands still but for who waits."""

    lost = 0

    def __init__(self, clock, messages):
        self.clock, self.messages = clock, list(messages)

    def take(self):
        there = [each for each in self.messages if each.arrived <= self.clock.now()]
        self.messages = self.messages[len(there) :]
        return there

    def absence(self):
        return "is anything there?"

    def close(self):
        self.messages = []


def arm(*drives, names=("a", "b"), **link):
    """An arm whose joints messages call as `names` do; `drives` are further keys of each joint's drive."""
    rows = drives or ({},) * len(names)
    joints = [
        {
            "name": f"joint_{k + 1}",
            "drive": {"family": "joint_state", "joint": name, **keys},
            "rated_torque": 10,
            "max_torque": 10,
        }
        for k, (name, keys) in enumerate(zip(names, rows, strict=True))
    ]
    stops = [{"name": each["name"], "lower": -100.0, "upper": 100.0, "a": 0.1} for each in joints]
    content = {"name": "two", "kinematics": {"joints": stops}, "link": {"joints": joints, "rate": 100, **link}}
    return parse_arm(content, Path("two.yaml"))


def message(k, position=(0.1, 0.2), names=("a", "b"), effort=(1.0, 2.0), stamp=None, source="one", **columns):
    """Message k of a publisher at 100 Hz, whose clock is 1000 s ahead, and which arrives 1 ms after its stamp."""
    t = 10.0 + 0.01 * k
    return JointStateMessage(
        source, t + 0.001, 1000.0 + t if stamp is None else stamp, names, position, (), effort, **columns
    )


def bus_of(messages, described=None):
    clock = FakeClock()
    described = described or arm()
    return ListeningBus(Script(clock, messages), "messages", message_names(described.require_link()), clock=clock)


def samples_of(messages, described=None, patience=0.2):
    """Samples of a listener, and its bus."""
    described = described or arm()
    bus = bus_of(messages, described)
    with Listener(described, bus) as listener:
        found = []
        while (sample := listener.next(patience)) is not None:
            found.append(sample)
    return found, bus


def test_a_message_is_a_sample_at_the_time_of_its_stamp():
    late = [
        message(0),
        message(1),
        message(2)._replace(arrived=10.035),
        message(3)._replace(arrived=10.036),
        message(4),
    ]
    found, _ = samples_of(late)
    assert len(found) == 4
    np.testing.assert_allclose(np.diff([each.t for each in found]), 0.01, atol=1e-5)
    np.testing.assert_allclose(found[0].position, [0.1, 0.2])
    np.testing.assert_allclose(found[0].torque, [1.0, 2.0])
    np.testing.assert_allclose(found[0].motor_torque, [1.0, 2.0])
    assert np.isnan(found[0].velocity).all()


def test_units_senses_and_names_are_those_of_the_arm_file():
    drives = (
        {"effort": "current", "torque_constant": 2.5, "direction": -1, "zero": 0.5},
        {"effort": "torque", "gear": 2.0},
    )
    found, _ = samples_of(
        [message(k, names=("gripper", "b", "a"), position=(9, 0.4, 0.1), effort=(9, 3.0, 1.0)) for k in range(3)],
        arm(*drives),
    )
    np.testing.assert_allclose(found[1].position, [0.4, 0.2])
    np.testing.assert_allclose(found[1].torque, [-2.5, 3.0])
    np.testing.assert_allclose(found[1].motor_torque, [-2.5, np.nan])


def test_publishers_of_parts_of_the_arm_make_one_sample():
    parts = [
        (message(k, (0.1,), ("a",), (1.0,), source=1), message(k, (0.2,), ("b",), (2.0,), source=2)) for k in range(4)
    ]
    found, bus = samples_of([each for pair in parts for each in pair])
    assert len(found) == 3
    assert all(np.isfinite(each.position).all() for each in found)
    assert not bus.remarks


def test_late_and_repeated_messages_are_left_out_and_said(caplog):
    order = [
        message(0),
        message(2, (0.3, 0.3)),
        message(1)._replace(arrived=10.0212),
        message(2)._replace(arrived=10.022),
    ]
    found, bus = samples_of([*order, message(3), message(4)])
    np.testing.assert_allclose([each.position[0] for each in found], [0.1, 0.3, 0.1])
    assert bus.said() == ["messages came late or twice: their time stamps are not newer than earlier ones (2 times)"]
    assert len([each for each in caplog.records if "late or twice" in each.message]) == 1


def test_a_dropped_message_is_a_longer_step_and_no_fault_of_a_joint():
    found, bus = samples_of([message(k) for k in (0, 1, 4, 5, 6)])
    np.testing.assert_allclose(np.diff([each.t for each in found]), [0.01, 0.03, 0.01], atol=1e-5)
    assert all((each.age == 0).all() for each in found)
    assert not bus.remarks


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_value_that_is_no_number_is_missing(value):
    found, bus = samples_of([message(0), message(1, (value, 0.2), effort=(1.0, value)), message(2), message(3)])
    assert np.isnan(found[1].position[0])
    np.testing.assert_allclose(found[1].position[1], 0.2)
    assert np.isnan(found[1].torque).all()
    assert bus.said() == [
        "a: the position in the message is not a number (1 times)",
        "b: the effort in the message is not a number (1 times)",
    ]


def test_without_effort_positions_are_heard_and_the_lack_is_said():
    found, bus = samples_of([message(k, effort=()) for k in range(3)])
    np.testing.assert_allclose(found[0].position, [0.1, 0.2])
    assert np.isnan(found[0].torque).all()
    assert bus.said()[0].startswith("messages have no effort")


def test_columns_that_are_too_short_are_missing_at_the_joints_without_a_value():
    found, bus = samples_of([message(k, position=(0.1,)) for k in range(3)])
    np.testing.assert_allclose(found[0].position, [0.1, np.nan])
    assert "b has none" in bus.said()[0]


def test_two_publishers_of_one_joint_are_not_mixed():
    pairs = [(message(k), message(k, (7.0, 7.0), source="two")) for k in range(4)]
    found, bus = samples_of([each for pair in pairs for each in pair])
    assert {each.position[0] for each in found} == {0.1}
    assert "two publishers send a, b" in bus.said()[0]


def test_another_publisher_takes_over_when_the_first_has_gone():
    found, _ = samples_of(
        [message(0), message(1), *(message(k, (7.0, 7.0), source="two") for k in range(150, 153))], patience=2.0
    )
    assert found[-1].position[0] == 7.0


def test_a_clock_that_is_set_back_does_not_stop_the_listening(caplog):
    found, _ = samples_of([message(0), message(1), *(message(k, stamp=5.0 + 0.01 * k) for k in range(2, 5))])
    assert len(found) == 4
    np.testing.assert_allclose(np.diff([each.t for each in found]), 0.01, atol=1e-5)
    assert "went back" in caplog.text


def test_messages_without_a_stamp_count_when_they_arrive():
    found, _ = samples_of([message(k, stamp=math.nan) for k in range(4)])
    np.testing.assert_allclose(np.diff([each.t for each in found]), 0.01, atol=1e-5)


def test_a_slow_drift_of_the_sender_s_clock_is_followed():
    clock = SenderClock()
    times = [clock.time(5.0 + 0.01 * k * (1 - 5e-5), 0.01 * k + 0.002) for k in range(100_000)]
    assert abs(times[-1] - (0.01 * 99_999 + 0.002)) < 1e-3


def test_messages_that_waited_when_listening_began_keep_their_times():
    waited = [message(k)._replace(arrived=9.9915) for k in range(-20, 0)]
    samples, _ = samples_of([*waited, *map(message, range(20))])
    assert np.diff([sample.t for sample in samples]) == pytest.approx(np.full(38, 0.01), abs=1e-3)


def test_why_nothing_is_heard():
    described = arm()
    assert bus_of([]).silence() == "no message has come: is anything there?"
    _, bus = samples_of([message(k, names=("left_wheel", "right_wheel")) for k in range(3)])
    assert "left_wheel, right_wheel, and none of a, b" in bus.silence()
    assert "joint: NAME" in bus.silence()
    _, bus = samples_of([message(k, stamp=7.0) for k in range(3)], described)
    assert "not newer than earlier ones" in bus.silence()


def test_monitor_and_recorder_hear_the_same():
    described = arm()
    answer = (watcher := Monitor(described, bus_of([message(k) for k in range(40)]))).describe(watcher.watch(0.2))
    assert [joint["position"] for joint in answer["joints"]] == [0.1, 0.2]
    assert answer["bus"]["rate_hz"] == pytest.approx(100, rel=0.1)
    rows = list(Recorder(described, bus_of([message(k, target=(0.5, 0.6)) for k in range(5)])).rows(0.2))
    np.testing.assert_allclose([t for t, _ in rows], np.arange(4) * 0.01, atol=1e-5)
    np.testing.assert_allclose(rows[1][1]["position_command"], [0.5, 0.6])


def test_an_arm_with_drives_is_heard_by_the_names_of_its_joints():
    described = load_arm("six-damiao")
    names = described.joint_names
    bus = bus_of([message(k, [0.1] * 6, names, [1.0] * 6) for k in range(3)], described)
    with Listener(described, bus) as listener:
        sample = listener.next(0.2)
        assert listener.arm.require_link().joints[0].settings.effort == "motor"
    np.testing.assert_allclose(sample.position, 0.1)
    np.testing.assert_allclose(sample.torque, 1.0)


def test_nothing_can_be_sent():
    bus = bus_of([])
    for port in (bus.open_port(), bus.open_listening_port()):
        with pytest.raises(ArmlinkError, match="listen-only"):
            port.send(0x201, b"\0")
    with pytest.raises(BadInput, match="listen-only"):
        Link(arm(), bus)
    with pytest.raises(BadInput, match="--frames"):
        bus.recv()


@pytest.mark.parametrize("name", ["joint_messages", "ros2", "lerobot", "servo_lines"])
def test_the_sources_have_no_way_to_send(name):
    """Structure: no writer, publisher or serial port is imported, and no method of a socket or port that sends is
    called."""
    folder = Path(inspect.getfile(joint_messages)).parent
    tree = ast.parse((folder / f"{name}.py").read_text())
    imported = {
        alias.name for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom) for alias in node.names
    }
    modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not imported & {"DataWriter", "Publisher", "serial", "can", "subprocess"}
    assert not any(each.startswith(("cyclonedds.pub", "serial", "can")) for each in modules)
    called = {
        node.func.attr for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    }
    assert not called & {"send", "sendto", "sendall", "sendmsg", "write", "writelines", "connect", "put", "tcdrain"}


def test_another_rate_than_that_of_the_arm_file_is_said_once():
    clock = FakeClock()
    bus = ListeningBus(Script(clock, [message(k) for k in range(700)]), "messages", ("a", "b"), rate=250.0, clock=clock)
    rows = list(Recorder(arm(), bus).rows(8.0))
    assert len(rows) == 699
    assert bus.said() == ["readings come at 100 Hz, and `link.rate` of the arm file is 250 Hz (1 times)"]
