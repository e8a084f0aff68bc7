"""Listening beside another controller: samples as a host would have them, and not a frame sent."""

import struct

import numpy as np
from wiretap import Tap, conversation

from armlink.link.listener import Listener

UNIT = 2 * np.pi / 2**20


def heard(listener, seconds):
    samples = []
    while (sample := listener.next(seconds)) is not None:
        samples.append(sample)
    return samples


def test_each_sync_of_the_other_controller_gives_one_sample(arm_of):
    listener = Listener(arm_of(2), Tap(conversation(9, lost=(3,))))
    samples = heard(listener, 1.0)
    assert len(samples) == 8  # the ninth is not complete before the next SYNC
    np.testing.assert_allclose(np.diff([sample.t for sample in samples]), 0.004, atol=1e-9)
    for cycle, sample in enumerate(samples):
        second = np.nan if cycle == 3 else 1.0
        np.testing.assert_allclose(sample.position, np.array([2000 * cycle + 1, (2000 * cycle + 2) * second]) * UNIT)
        np.testing.assert_allclose(sample.torque, np.array([cycle, cycle * second]))
    assert samples[4].age[1] == 0.0
    assert samples[3].age[1] > 0.0
    assert listener.stats.missed == 1


def test_the_other_controllers_commands_are_known_for_each_sample(arm_of):
    listener = Listener(arm_of(2), Tap(conversation(4)))
    assert np.isnan(listener.torque_sent).all()
    for cycle in range(3):
        assert listener.next(1.0) is not None
        np.testing.assert_allclose(listener.torque_sent, 0.4 * cycle)  # 10 ‰ of 40 N·m a cycle
        np.testing.assert_allclose(listener.position_sent, 1000 * cycle * UNIT)


def test_a_joint_without_a_command_has_none(arm_of):
    listener = Listener(arm_of(2), Tap(frame for frame in conversation(3) if frame[1] != 0x202))
    heard(listener, 1.0)
    np.testing.assert_array_equal(np.isnan(listener.torque_sent), [False, True])
    np.testing.assert_array_equal(np.isnan(listener.position_sent), [False, True])


def test_a_silent_bus_gives_nothing_and_takes_no_longer_than_asked(arm_of):
    tap = Tap([])
    assert Listener(arm_of(2), tap).next(0.5) is None
    assert 100.5 <= tap.time < 100.6


def test_emergencies_and_restarts_are_kept(arm_of):
    frames = [(100.0, 0x80, b""), (100.001, 0x81, struct.pack("<HB5x", 0x4310, 1)), (100.002, 0x702, b"\0")]
    listener = Listener(arm_of(2), Tap(frames))
    listener.next(0.1)
    assert [(each.joint, each.code) for each in listener.emergencies] == [(0, "4310h")]
    assert listener.groups[0].drives.known.node_states == {1: 0}
