"""Joint states of ROS 2 over DDS, from a publisher that is not ours, on this machine alone."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from armlink.arm_file import load_arm
from armlink.bus.open import open_link_bus
from armlink.errors import BadInput
from armlink.link.listener import Listener

pytest.importorskip("cyclonedds", reason="the extra ros2 is not installed")

PUBLISHER = """
import itertools, sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

@dataclass
class Time_(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32

@dataclass
class Header_(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time_
    frame_id: str

@dataclass
class JointState_(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header_
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]

quality = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
participant = DomainParticipant()
topic = Topic(participant, sys.argv[1], JointState_, qos=quality)
writer = DataWriter(participant, topic, qos=quality)
names = ["gripper", *(f"joint_{k}" for k in range(1, 8))]
for k in itertools.count(1):
    stamp = Time_(5000 + k // 100, k % 100 * 10_000_000)
    position, effort = [0.01 * j for j in range(8)], [1.0 * j for j in range(8)]
    writer.write(JointState_(Header_(stamp, ""), names, position, [0.0] * 8, effort))
    time.sleep(0.01)
"""
CYCLONEDDS = (
    "<Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General></Domain>"
)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain for this test, whatever others run beside it, that no other computer hears."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(100 + os.getpid() % 100))
    monkeypatch.setenv("CYCLONEDDS_URI", CYCLONEDDS)


@pytest.fixture
def publisher(domain: None, tmp_path: Path) -> Iterator[None]:
    script = tmp_path / "publisher.py"
    script.write_text(PUBLISHER.replace("DomainParticipant()", f"DomainParticipant({os.environ['ROS_DOMAIN_ID']})"))
    with subprocess.Popen([sys.executable, str(script), "rt/arm/joint_states"]) as process:
        yield
        process.kill()


def test_a_foreign_publisher_is_heard(publisher: None) -> None:
    arm = load_arm("sarcos")
    with Listener(arm, open_link_bus("ros2:/arm/joint_states", arm.require_link())) as listener:
        found = [sample for _ in range(20) if (sample := listener.next(20.0)) is not None]
    assert len(found) == 20
    np.testing.assert_allclose(found[-1].position, 0.01 * np.arange(1, 8))
    np.testing.assert_allclose(found[-1].torque, np.arange(1, 8))
    steps = np.diff([each.t for each in found])
    np.testing.assert_allclose(np.round(steps, 2) % 0.01, 0.0, atol=1e-9)  # stamps of 100 Hz, however they arrived


def test_a_topic_that_nobody_publishes_is_silent(domain: None) -> None:
    arm = load_arm("sarcos")
    bus = open_link_bus("ros2:/nothing", arm.require_link())
    with Listener(arm, bus) as listener:
        assert listener.next(0.1) is None
        assert "does a publisher of /nothing run in ROS domain" in bus.silence()


@pytest.mark.parametrize("given", ["-1", "233", "ours"])
def test_an_impossible_domain(given: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", given)
    with pytest.raises(BadInput, match=f"ROS_DOMAIN_ID is '{given}'"):
        open_link_bus("ros2:/joint_states", load_arm("sarcos").require_link())
