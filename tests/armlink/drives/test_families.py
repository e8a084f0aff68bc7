"""Each drive family on its simulated drives, without the link: set-up, cycle, silence, faults, limits, any bytes."""

import math
import re
import struct
from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from bench import Bench
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from wiretap import Tap

from armlink.arm_file import load_arm, parse_arm
from armlink.bus.frame_bits import FIXED_BITS, frame_bits, longest_frame_bits
from armlink.bus.frame_log import FrameLog, LogBus
from armlink.bus.message_port import as_message
from armlink.bus.port import EXTENDED, REMOTE
from armlink.bus.taps import TappedPort
from armlink.drives.damiao import frames as damiao
from armlink.drives.family import family
from armlink.drives.mit_packing import MitFeedback
from armlink.drives.moteus import frames as moteus
from armlink.drives.odrive import frames as odrive
from armlink.drives.orders import Limits, Mode, Order, Power
from armlink.drives.robstride import frames as robstride
from armlink.errors import BadInput, BusFault, Stall
from armlink.link.link import Link
from armlink.link.types import Command
from armlink.recording.recorder import Recorder
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

ARMS = ("six-damiao", "six-cubemars", "six-robstride", "six-moteus", "six-odrive", "six-myactuator", "six-piper")
MIT = (*ARMS[:3], "six-piper")
PACKED_ALIKE = ARMS[:2]
every_arm = pytest.mark.parametrize("name", ARMS)
NAN = math.nan


@pytest.fixture
def bench(name):
    bench = Bench(name)
    bench.set_up()
    return bench


def hold(bench, cycles, position):
    for _ in range(cycles):
        bench.cycle([bench.order(j, position=position[j]) for j in range(6)])


def half_step(bench, joint):
    """Rounding of a torque that is ordered, 0 for drives without packed torques [N·m]."""
    grid = getattr(bench.drives.memory[joint], "grid", None)
    return grid.torque.span / grid.torque.most / 2 if grid else 0.0


# ---- the way from power on to power off


@every_arm
def test_identity_of_every_drive(name):
    bench = Bench(name)
    found = bench.drives.identify(bench)
    assert [each.present for each in found] == [True] * 6
    assert not any(each.mismatch for each in found)
    bench.simulated[2].unplugged = True
    assert [each.present for each in bench.drives.identify(bench)] == [True, True, False, True, True, True]


@every_arm
def test_set_up_leaves_the_motors_without_power_and_flash_alone(bench):
    assert not any(bench.powered)
    bench.walk()
    hold(bench, 20, bench.position)
    assert all(device.flash_writes == 0 for device in bench.simulated)


@every_arm
def test_it_holds_where_it_stands_and_makes_the_torque_that_is_ordered(bench):
    assert bench.walk()
    assert all(bench.powered)
    hold(bench, 50, start := bench.position)
    assert np.abs(bench.position - start).max() < 0.02 * max(row.settings.gear for row in bench.link.joints)
    assert bench.drives.fault([Mode.POSITION] * 6, bench.arm.time) is None
    asked = 0.2
    for _ in range(3):
        bench.cycle([bench.order(j, mode=Mode.TORQUE, torque=asked) for j in range(6)])
    ratio = np.array([row.settings.direction * row.settings.gear for row in bench.link.joints])
    steps = [max(half_step(bench, joint), 0.05) for joint in range(6)]
    assert (np.abs(bench.arm.plant.motor_torque - asked * ratio) < steps).all()
    told = [reading.motor_torque for reading in bench.latest]
    assert told == pytest.approx([asked] * 6, abs=0.15)  # noise of the current sensors


@every_arm
def test_readings_are_those_of_the_arm_in_the_drives_own_sense(bench):
    bench.walk()
    hold(bench, 5, bench.position)
    angles = [bench.at_joint(j, bench.latest[j].position) for j in range(6)]
    assert angles == pytest.approx(list(bench.arm.plant.position), abs=2e-3)
    assert all(30 < reading.temperature < 35 for reading in bench.latest)


@every_arm
def test_a_silent_host_ends_as_the_traits_say(bench):
    bench.walk()
    for _ in range(5):
        bench.cycle([bench.order(j, mode=Mode.TORQUE, torque=0.3) for j in range(6)])
    bench.arm.advance(2 * bench.link.deadline + 0.2)
    silence = bench.drives.traits(0).silence
    assert bench.powered == [silence in ("damps", "keeps on")] * 6
    if silence == "damps":
        assert np.abs(bench.arm.plant.velocity).max() < 0.5
    bench.listen()
    bench.cycle([bench.order(j) for j in range(6)])
    fault = bench.drives.fault([Mode.POSITION] * 6, bench.arm.time)
    assert isinstance(fault, Stall)
    assert bench.drives.names[0] in str(fault)
    assert bench.drives.own_stop(0)
    bench.drives.forget()
    assert bench.walk()


@every_arm
def test_off_is_off_and_an_order_without_a_walk_never_switches_on(bench):
    bench.walk()
    assert bench.walk(Power.OFF)
    assert not any(bench.powered)
    for mode in (Mode.POSITION, Mode.TORQUE):
        for _ in range(30):
            bench.cycle([bench.order(j, mode=mode, torque=0.5) for j in range(6)])
    assert not any(bench.powered)


@every_arm
def test_stopped_is_the_safest_state_that_the_drive_has(bench):
    bench.walk()
    hold(bench, 10, bench.position)
    for _ in range(60):
        bench.cycle([bench.order(j, power=Power.STOPPED) for j in range(6)])
    assert [bench.drives.power(j) for j in range(6)] == [Power.STOPPED] * 6
    assert np.abs(bench.arm.plant.velocity).max() < 0.3


@every_arm
def test_a_drive_that_lost_its_encoder_is_a_fault_or_silent(bench):
    bench.walk()
    bench.simulated[3].inject("feedback.lost", 0.0)
    came = bench.arm.time
    for _ in range(60):
        bench.latest[3] = bench.latest[3]._replace(position=NAN)
        bench.cycle([bench.order(j, position=0.0 if j == 3 else None) if j != 3 else None for j in range(6)])
        bench.cycle([bench.order(j, position=1.0) if j == 3 else bench.order(j) for j in range(6)])
    fault = bench.drives.fault([Mode.POSITION] * 6, bench.arm.time)
    told = fault is not None and bench.drives.names[3] in str(fault)
    assert told or math.isnan(bench.latest[3].position)
    assert bench.arm.time > came


@every_arm
def test_a_command_before_the_set_up_is_refused(name):
    bench = Bench(name)
    orders = [bench.order(j, position=0.0, walk=True) for j in range(6)]
    for _ in range(5):
        with suppress(BusFault):
            bench.cycle(orders)
    assert not any(bench.powered)


# ---- what set-up refuses


def test_damiao_scales_come_from_the_registers():
    bench = Bench("six-damiao")
    bench.simulated[2].registers[22] = 8.0
    assert bench.set_up()[2].scales["velocity range, rad/s"] == 8.0
    bench.walk()
    assert bench.drives.memory[2].grid.ranges.velocity == 8.0


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda drive: drive.registers.update({10: 2}) or drive.inject("mode.refused", 0), "not in MIT mode"),
        (lambda drive: drive.registers.update({21: 0.0}), "not a usable scale"),
        (lambda drive: drive.registers.update({7: 0}), "replies on id 00h"),
        (lambda drive: setattr(drive, "unplugged", True), "no answer from id 02h"),
    ],
)
def test_damiao_set_up_refuses(spoil, says):
    bench = Bench("six-damiao")
    spoil(bench.simulated[1])
    with pytest.raises((BusFault, BadInput), match=says) as caught:
        bench.set_up()
    assert str(caught.value).startswith("shoulder")


def set_up_in_mode(arm, mode):
    """A bench whose drives were in this mode of control before they were set up."""
    bench = Bench(arm)
    for device in bench.simulated:
        device.inject("drive.mode", mode)
    bench.set_up()
    return bench


def test_damiao_mode_is_written_and_read_back():
    bench = set_up_in_mode("six-damiao", 2)
    assert [device.registers[10] for device in bench.simulated] == [1] * 6
    assert [device.registers[9] for device in bench.simulated] == [2000] * 6


def test_robstride_without_a_deadman_is_refused():
    bench = Bench("six-robstride")
    del bench.simulated[4].parameters[robstride.RobStrideParameter.TIMEOUT]
    with pytest.raises(BusFault, match="wrist_2: its firmware has no parameter 7028h"):
        bench.set_up()


def test_robstride_modes_and_limits_are_read_back():
    bench = set_up_in_mode("six-robstride", 1)
    assert [device.parameters[0x7005] for device in bench.simulated] == [0] * 6
    assert [device.parameters[0x700B] for device in bench.simulated] == [36.0, 36.0, 18.0, 6.0, 6.0, 5.5]
    assert [device.parameters[0x7028] for device in bench.simulated] == [2000] * 6


def test_moteus_needs_can_fd_and_a_referenced_output():
    described = load_arm("six-moteus")
    link = described.link.model_copy(update={"bus": described.link.bus.model_copy(update={"fd": False})})
    with pytest.raises(BadInput, match="fd: true"):
        family("moteus").build(described.model_copy(update={"link": link}), link.joints)


def test_odrive_without_torque_messages_says_what_is_lost():
    bench = Bench("six-odrive")
    for device in bench.simulated:
        device._cyclic.pop(odrive.Message.TORQUES)
    bench.arm.outbox.clear()
    found = bench.set_up()
    assert found[0].modes == {Mode.POSITION}
    assert "torques_msg_rate_ms" in found[0].lost[0]


def test_odrive_that_sends_no_estimates():
    bench = Bench("six-odrive")
    bench.simulated[0]._cyclic.pop(odrive.Message.ESTIMATES)
    bench.arm.outbox.clear()
    with pytest.raises(BusFault, match="base: node 1 sends no encoder estimates"):
        bench.set_up()


def test_the_window_must_fit_what_a_frame_can_carry():
    bench = Bench("six-damiao")
    bench.limits[1] = Limits(36.0, 300.0, 1.0, -3.0, 13.0, 0.1, 0.004)
    with pytest.raises(BadInput, match="shoulder: its position window"):
        bench.set_up()


# ---- no frame beyond a limit, under arbitrary orders, lying feedback and any bytes; asserted on the bytes


@cache
def prepared(name):
    """A bench whose drives are on; the limits are tight, so that they count."""
    bench = Bench(name)
    bench.limits = [Limits(0.3 * row.max_torque, 100.0, 1.0, -2.5, 2.5, 0.1, 0.004) for row in bench.link.joints]
    bench.set_up()
    assert bench.walk()
    return bench


def told(name, bench, joint, frames):
    """(torque, position, kp, kd, velocity, largest torque) as the bytes for a joint tell them, by code of the test."""
    row = bench.link.joints[joint].settings
    found = []
    for can_id, data in frames:
        if name in PACKED_ALIKE and can_id == row.id and data[:7] != b"\xff" * 7:
            device = bench.simulated[joint]
            p, v, t = (
                device.coding.ranges[:3] if name == "six-cubemars" else (device.registers[r] for r in (21, 22, 23))
            )
            bits = int.from_bytes(data, "big")
            q, dq = bits >> 48, bits >> 36 & 0xFFF
            kp, kd, torque = bits >> 24 & 0xFFF, bits >> 12 & 0xFFF, bits & 0xFFF
            found.append(
                (torque / 4095 * 2 * t - t, q / 65535 * 2 * p - p, kp / 4095 * 500, kd / 4095 * 5,
                 dq / 4095 * 2 * v - v, math.inf)
            )  # fmt: skip
        elif name == "six-robstride" and can_id >> 24 & 0x1F == 1 and can_id & 0xFF == row.id:
            p, v, t, most_kp, most_kd = robstride.RANGES[row.model]
            q, dq, kp, kd = struct.unpack(">4H", data)
            torque = (can_id >> 8 & 0xFFFF) / 65535 * 2 * t - t
            found.append(
                (torque, q / 65535 * 2 * p - p, kp / 65535 * most_kp, kd / 65535 * most_kd,
                 dq / 65535 * 2 * v - v, math.inf)
            )  # fmt: skip
        elif name == "six-moteus" and can_id & 0xFF == row.id:
            values = {each.register: each.value for each in moteus.unpack(data) if each.kind == moteus.WRITE}
            if values.get(0) == 10:
                found.append((values[0x22], values[0x20] * 2 * math.pi, 0.0, 0.0, 0.0, values[0x25]))
        elif name == "six-odrive" and can_id >> 5 == row.node:
            if can_id & 0x1F == 0x0E:
                found.append((struct.unpack_from("<f", data)[0], NAN, 0.0, 0.0, 0.0, math.inf))
            elif can_id & 0x1F == 0x0C:
                position, _, ahead = struct.unpack("<fhh", data)
                found.append((ahead / 1000, position * 2 * math.pi, 0.0, 0.0, 0.0, math.inf))
        elif name == "six-piper" and can_id == 0x159 + row.joint:
            bits, amplified = int.from_bytes(data, "big"), 4.0 if row.joint <= 3 else 1.0
            q, dq, kp, kd = bits >> 48, bits >> 36 & 0xFFF, bits >> 24 & 0xFFF, bits >> 12 & 0xFFF
            torque = ((bits >> 4 & 0xFF) / 255 * 16 - 8) * amplified
            assert kd >= 0x800, "damping that pushes"
            found.append((torque, q / 65535 * 25 - 12.5, kp / 4095 * 500, kd / 4095 * 10 - 5,
                          dq / 4095 * 90 - 45, math.inf))  # fmt: skip
        elif name == "six-myactuator" and can_id == 0x140 + row.id and data[0] == 0xA1:
            found.append((struct.unpack_from("<h", data, 4)[0] * 0.01 * row.constant, NAN, 0.0, 0.0, 0.0, math.inf))
        elif name == "six-myactuator" and can_id == 0x140 + row.id and data[0] == 0xA4:
            found.append((0.0, math.radians(struct.unpack_from("<i", data, 4)[0] / 100), 1.0, 0.0, 0.0, math.inf))
    return found


def check(name, bench, joint, order, frames):
    limits, reading = bench.limits[joint], bench.drives.memory[joint]
    for torque, position, kp, kd, velocity, largest in told(name, bench, joint, frames):
        assert abs(torque) <= limits.max_torque
        assert largest == math.inf or largest <= limits.max_torque
        if order.mode == Mode.POSITION and limits.lower <= order.position <= limits.upper and kp > 0:
            assert limits.lower <= position <= limits.upper
        if name in MIT and math.isfinite(reading.position + reading.velocity):
            error, short = order.position - reading.position, order.velocity - reading.velocity
            asked = order.torque + (order.kp * error + order.kd * short) * (order.mode == Mode.POSITION)
            if abs(asked) <= limits.max_torque:  # as the gate passes it
                sum_told = kp * (position - reading.position) + kd * (velocity - reading.velocity) + torque
                assert abs(sum_told) <= limits.max_torque + 1e-9


def check_safe(name, bench, joint):
    """What a keeper would send now: it is within limits where it holds, and nothing pushes."""
    limits, reading = bench.limits[joint], bench.drives.memory[joint]
    for torque, position, kp, kd, velocity, _ in told(name, bench, joint, bench.drives.safe_frames(joint)):
        assert abs(torque) <= limits.max_torque
        assert abs(velocity) < 0.02
        assert kp == 0 or limits.lower <= position <= limits.upper
        if math.isfinite(reading.position + reading.velocity):
            total = kp * (position - reading.position) + kd * (velocity - reading.velocity) + torque
            assert abs(total) <= limits.max_torque + 1e-9
            drift, step = abs(reading.velocity) * limits.deadline, 500 / 4095
            assert (kp - step) * drift <= limits.max_torque


numbers = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False, width=32), st.floats(-3, 3), st.floats(-40, 40), st.just(0.0)
)
orders = st.builds(
    Order,
    power=st.sampled_from([Power.ON, Power.ON, Power.STOPPED, Power.OFF]),
    walk=st.booleans(),
    mode=st.sampled_from([Mode.POSITION, Mode.TORQUE]),
    position=numbers,
    velocity=numbers,
    torque=numbers,
    kp=st.floats(0, 500),
    kd=st.floats(0, 5),
)


def lies(name, draw, bench, joint):
    """A frame of the joint's drive with any bytes in it."""
    row = bench.link.joints[joint].settings
    if name == "six-damiao":
        return row.reply, draw.draw(st.binary(max_size=8))
    if name == "six-cubemars":
        return row.reply, bytes([row.id]) + draw.draw(st.binary(max_size=7))
    if name == "six-robstride":
        head = draw.draw(st.integers(0, 255))
        return 2 << 24 | head << 16 | row.id << 8 | row.host | EXTENDED, draw.draw(st.binary(max_size=8))
    if name == "six-moteus":
        number = row.id << 8 | row.source
        return number | EXTENDED * (number > 0x7FF), draw.draw(st.binary(max_size=64))
    if name == "six-myactuator":
        command = draw.draw(st.sampled_from([0x80, 0x81, 0x92, 0x9A, 0x9C, 0xA1, 0xA4, 0xB1]))
        return 0x240 + row.id, bytes([command]) + draw.draw(st.binary(min_size=6, max_size=7))
    if name == "six-piper":
        ids = (0x2A1, 0x2A5 + joint // 2, 0x250 + row.joint, 0x260 + row.joint)
        return draw.draw(st.sampled_from(ids)), draw.draw(st.binary(min_size=7, max_size=8))
    return row.node << 5 | draw.draw(st.integers(0, 31)), draw.draw(st.binary(max_size=8))


@every_arm
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
def test_no_frame_leaves_beyond_a_limit(name, draw):
    bench = prepared(name)
    for _ in range(5):
        for joint in draw.draw(st.lists(st.integers(0, 5), max_size=3)):
            bench.hear(*lies(name, draw, bench, joint))
        asked = [draw.draw(orders) if j < 2 else bench.order(j, position=0.0) for j in range(6)]
        honest = draw.draw(st.booleans())
        sent = bench.cycle(asked) if honest else bench.drives.frames(asked, bench.arm.time)
        for joint in range(2):
            # limits hold on the bytes by what was known when they were made
            if not bench.arm.outbox:
                check(name, bench, joint, asked[joint], bench.drives.frames([*asked], bench.arm.time))
                check_safe(name, bench, joint)
            for torque, *_, largest in told(name, bench, joint, sent):
                assert abs(torque) <= bench.limits[joint].max_torque
                assert largest == math.inf or largest <= bench.limits[joint].max_torque


@every_arm
@settings(max_examples=30, deadline=None)
@given(value=st.sampled_from([NAN, math.inf, -math.inf]), place=st.sampled_from(["position", "velocity", "torque"]))
def test_a_number_that_is_not_finite_never_becomes_a_frame(name, value, place):
    bench = prepared(name)
    mode = Mode.TORQUE if place == "torque" else Mode.POSITION
    bench.drives.forget(restarts=True)  # of which another test's bytes may have told
    bench.walk()
    order = bench.order(0, mode=mode, position=0.0)._replace(**{place: value})
    with pytest.raises(ValueError):
        bench.drives.frames([order, *[None] * 5], bench.arm.time)


@pytest.mark.parametrize("name", [*ARMS, "six-cia402"])
def test_fuzzed_frames_raise_nothing_and_read_nothing_that_is_not_a_number(name):
    """1,500 frames a family here; the campaign tests/campaigns/fuzz_drives.py has 100,000."""
    from fuzzing import fuzz

    assert fuzz(name, 1500, seed=1) == 1500


# ---- beside another host


@every_arm
def test_orders_of_another_host_are_decoded_from_its_frames(bench):
    listener = Bench(bench.described)
    listener.set_up()
    bench.walk()
    for _ in range(3):
        frames = bench.cycle([bench.order(j, mode=Mode.TORQUE, torque=0.2 + 0.01 * j) for j in range(6)])
    found = dict(each for each in (listener.drives.command_of(*frame) for frame in frames) if each is not None)
    for joint in range(6):
        assert found[joint].mode == Mode.TORQUE
        assert found[joint].torque == pytest.approx(0.2 + 0.01 * joint, abs=max(half_step(bench, joint), 0.02))


@every_arm
def test_another_hosts_commands_are_known_as_such(bench):
    other = Bench(bench.described)
    other.set_up()
    other.walk()
    frames = other.cycle([other.order(j) for j in range(6)])
    named = [bench.drives.commands().get(can_id) for can_id, _ in frames]
    assert all(named) or all(bench.drives.intrusion(*frame) for frame in frames)
    if not all(named):  # its identifiers carry data: the drives themselves see it
        for frame in frames:
            bench.hear(*frame)
        assert "another host" in str(bench.drives.alarm())
        bench.drives.forget()
        assert bench.drives.alarm() is None


@pytest.mark.parametrize("name", MIT)
def test_a_recording_beside_another_host_has_the_torque_that_its_commands_ask_for(bench):
    """Rebuilt at the joint from both gains, both targets and the torque of each command, of the cycle that it led."""
    bench.walk()
    rows, frames, period = bench.link.joints, [], bench.period
    start, position, expected = bench.position, [], []
    for cycle in range(12):
        t = 100.0 + cycle * period
        orders = [bench.order(j, position=start[j] + 0.002 * cycle, torque=0.1 * (j + 1)) for j in range(6)]
        bench.heard.clear()
        frames += [(t, *frame) for frame in bench.cycle(orders)]
        frames += [(t + period / 2, *frame) for frame in bench.heard]
        torques = []
        for j, (sent, read) in enumerate(zip(map(bench.drives.sent, range(6)), bench.latest, strict=True)):
            law = sent.kp * (sent.position - read.position) + sent.kd * (sent.velocity - read.velocity) + sent.torque
            torques.append(rows[j].settings.direction * rows[j].settings.gear * law)
        expected.append(torques)
        position.append([bench.at_joint(j, bench.drives.sent(j).position) for j in range(6)])
    recorded = [row for _, row in Recorder(bench.described, Tap(frames)).rows(1.0)]
    assert len(recorded) == 11  # the last is not complete before the next command
    np.testing.assert_allclose([row["position_command"] for row in recorded], position[:-1], atol=1e-9)
    np.testing.assert_allclose([row["torque_command"] for row in recorded], expected[:-1], atol=1e-9)
    assert np.ptp(expected, axis=0).min() > 0.01  # both gains are in it: the torques differ from row to row


@every_arm
@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_a_frame_log_keeps_frames_of_every_kind(bench, suffix, tmp_path):
    """Identifiers of 29 bits and frames of CAN FD too: a recording of the log is that of the frames."""
    bench.walk()
    frames, start = [], bench.position
    for cycle in range(8):
        bench.heard.clear()
        sent = bench.cycle([bench.order(j, position=start[j] + 0.01 * cycle) for j in range(6)])
        frames += [(100.0 + cycle * bench.period, *frame) for frame in sent]
        frames += [(100.0 + (cycle + 0.5) * bench.period, *frame) for frame in bench.heard if not frame[0] & REMOTE]
    live = [row for _, row in Recorder(bench.described, Tap(frames)).rows(1.0)]
    with FrameLog(tmp_path / f"log{suffix}") as log:
        for t, can_id, data in frames:
            if not can_id & REMOTE:
                log.write(as_message(can_id, data, bench.link.bus.fd), round(t * 1e6))
    logged = [row for _, row in Recorder(bench.described, LogBus(tmp_path / f"log{suffix}")).rows(1.0)]
    assert len(live) == len(logged) >= 7
    for one, other in zip(live, logged, strict=True):
        for channel, values in one.items():
            np.testing.assert_array_equal(values, other[channel], err_msg=channel)


def test_a_listener_takes_what_a_robstride_drive_replies_to_a_host_of_any_id():
    listener, host = Bench("six-robstride"), 0xAA
    motion = MitFeedback(0.5, -1.0, 2.0)
    frame = robstride.pack_feedback(robstride.Feedback(2, 0, 2, motion, 30.0), host, listener.drives.memory[1].grid)
    reading = listener.drives.take(frame[0] | EXTENDED, frame[1], 0.0)
    assert reading.joint == 1
    assert tuple(reading[1:4]) == pytest.approx(tuple(motion), abs=1e-2)
    listener.set_up()
    assert listener.drives.take(frame[0] | EXTENDED, frame[1], 0.0) is None  # a host takes what is said to it


# ---- the load of the bus


def test_seven_damiao_joints_at_250_hz_on_classical_can():
    """The load of docs/drive-families.md against the bits of every frame on the simulated bus, stuff bits included."""
    described = load_arm("openarm")
    link = described.link.model_copy(update={"rate": 250.0})
    described = described.model_copy(update={"link": link, "serial": "SIM-LOAD"})
    tapped = []
    with Link(described, LockStepBus(arm=SimulatedArm(described, Truth.of(described)))) as host:
        host.start()
        start = host.enable().position
        loop = host._loop
        loop._port = TappedPort(loop._port, host.clock, lambda t, can_id, data: tapped.append((can_id, data)))
        host._loop.reset_counters()
        began, cycles = host.clock.now(), 250
        for cycle in range(cycles):
            host.cycle(Command.hold(start + 0.1 * np.sin(0.02 * cycle)))
        seconds = host.clock.now() - began
        told, frames = loop.bits / seconds / 1e6, tapped.copy()
    assert seconds == pytest.approx(1.0, abs=0.005)
    assert len(frames) == 14 * cycles  # a command and a reply of eight bytes a joint
    measured = sum(frame_bits(*each) for each in frames) / seconds / 1e6
    bare, most = (14 * bits * 250 / 1e6 for bits in (FIXED_BITS + 64, longest_frame_bits(8)))
    assert told == pytest.approx(bare, rel=0.01)  # 0.389: what the link counts has no stuff bits
    assert bare < measured < most  # 0.473 with every stuff bit that there can be
    assert measured == pytest.approx(14 * 118 * 250 / 1e6, rel=0.03)  # 0.413, as the page has it


def test_settings_are_checked_by_key(tmp_path):
    wrong = {
        "id": (0, "greater than or equal to 1"),
        "kp": (600.0, "less than or equal to 500"),
        "reply": ("x", "valid integer"),
    }
    for key, (value, says) in wrong.items():
        drive = {"family": "damiao", "id": 1, "reply": 0x11, "kp": 10, "kd": 0.5} | {key: value}
        content = {
            "name": "one",
            "kinematics": {"joints": [{"name": "hinge", "lower": -1.0, "upper": 1.0}]},
            "link": {"joints": [{"name": "hinge", "drive": drive, "rated_torque": 1.0, "max_torque": 1.0}]},
        }
        with pytest.raises(BadInput, match=f"drive.{key}: .*{says}"):
            parse_arm(content, tmp_path / "arm.yaml")


def test_a_register_answer_is_no_reading():
    bench = prepared("six-damiao")
    before = bench.drives.memory[0].position
    assert bench.drives.take(0x11, struct.pack("<HBBf", 1, 0x33, 21, 12.5), 0.0) is None
    assert bench.drives.take(0x11, damiao.read_request(1, 9), 0.0) is None
    assert bench.drives.memory[0].position == before


# ---- keys of CubeMars drives


def cubemars_pair(tmp_path, *drives):
    names = [f"j{place}" for place in range(len(drives))]
    rows = [
        {"name": name, "drive": drive, "rated_torque": 1.0, "max_torque": 1.0}
        for name, drive in zip(names, drives, strict=True)
    ]
    joints = [{"name": name, "lower": -1.0, "upper": 1.0} for name in names]
    content = {"name": "pair", "kinematics": {"joints": joints}, "link": {"joints": rows}}
    return parse_arm(content, tmp_path / "pair.yaml")


AK = {"family": "cubemars", "id": 1, "model": "AK80-9", "kp": 10, "kd": 0.5}


def test_cubemars_ranges_are_the_models_or_those_of_the_arm_file(tmp_path):
    own = {"position_range": 95.5, "velocity_range": 45.0, "torque_range": 18.0}
    arm = cubemars_pair(tmp_path, {**AK, "velocity_range": 25.64}, {**AK, "id": 2, "model": "V1", **own})
    assert [tuple(joint.settings.ranges) for joint in arm.link.joints] == [
        (12.5, 25.64, 18.0, 500.0, 5.0),
        (95.5, 45.0, 18.0, 500.0, 5.0),
    ]


@pytest.mark.parametrize(
    ("drives", "says"),
    [
        ([{**AK, "model": "AK1"}], "model 'AK1' is unknown: give one of AK10-9"),
        ([{**AK, "reply": 1}], "reply 0x01 is the id of the drive itself"),
        ([AK, {**AK, "id": 2, "reply": 1}], "j1: drive.reply 0x01 is also the id of commands to j0"),
        (
            [AK, {"family": "canopen", "node": 5}],
            "j1: a CANopen node would read CubeMars replies on id 0 as NMT",
        ),
        ([{**AK, "can_timeout": -1}], "drive.can_timeout: "),
    ],
)
def test_cubemars_keys_that_cannot_be(tmp_path, drives, says):
    def build():
        arm = cubemars_pair(tmp_path, *drives)
        family("cubemars").build(arm, [joint for joint in arm.link.joints if joint.settings.family == "cubemars"])

    with pytest.raises(BadInput, match=re.escape(says)) as caught:
        build()
    assert "\n" not in str(caught.value)


def test_a_drive_that_restarted_and_makes_no_torque_is_a_fault():
    """Its replies tell no state: what its commands ask for and what it makes are compared, for the deadline."""
    bench = Bench("six-cubemars")
    bench.set_up()
    bench.walk()
    bench.simulated[1].reboot()
    began, fault = bench.arm.time, None
    while fault is None and bench.arm.time < began + 1.0:
        bench.cycle([bench.order(j, mode=Mode.TORQUE, torque=2.0 if j == 1 else 0.1) for j in range(6)])
        fault = bench.drives.fault([Mode.TORQUE] * 6, bench.arm.time)
    assert 0.1 < bench.arm.time - began < 0.15
    assert "shoulder (id 02h): makes no torque although its commands ask for torque" in str(fault)
    bench.drives.forget()
    assert bench.walk()


def test_a_cubemars_drive_that_answers_another_host_is_not_told_to_leave_motor_mode():
    bench, other = Bench("six-cubemars"), Bench("six-cubemars")
    other.set_up()
    other.walk()
    frames = other.cycle([other.order(j) for j in range(6)])
    replies = other.heard[-6:]
    bench.wait = lambda done, timeout: [bench.hear(*frame) for frame in replies] and done()
    assert [each.present for each in bench.drives.identify(bench)] == [True] * 6
    assert bench.log == []
    assert len(frames) == 6
