"""What the link notices besides readings: another controller, a refused mode, a restart, a second host, a babbler."""

import contextlib
import struct

import numpy as np
import pytest
import yaml

from armlink.arm_file import bundled_arms, load_arm
from armlink.cli import run
from armlink.errors import BadInput, BusFault, HostLate, Refused
from armlink.link.link import Link
from armlink.link.types import Command
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

QUICK_STOP, SWITCH_ON_DISABLED = 0x07, 0x40
POSITION, TORQUE, PROFILE_POSITION, PROFILE_TORQUE = 8, 10, 1, 4


def command(mode, torque=0.0, position=0.0, n=3):
    return Command(np.full(n, mode, np.int8), np.full(n, torque), np.full(n, position))


def cycles_until_fault(link, given, each=lambda: None, limit=60):
    for cycle in range(limit):
        each()
        try:
            link.cycle(given)
        except BusFault as fault:
            return cycle, str(fault)
    raise AssertionError(f"no fault in {limit} cycles")


def all_stopped(bus):
    return [node.status for node in bus.nodes.values()] == [QUICK_STOP] * len(bus.nodes)


# ---- identity


def test_the_controller_that_the_arm_file_states_is_taken(arm_of, bus):
    stated = {"vendor": 0x11, "product": 0x22, "revision": 0x33}
    with Link(arm_of(joint={"identity": stated}), bus) as link:
        link.start()
        link.enable()


@pytest.mark.parametrize(
    ("key", "sub", "found"),
    [("vendor", 1, "0x11"), ("product", 2, "0x22"), ("revision", 3, "0x33"), ("serial", 4, "0x65")],
)
def test_another_controller_than_the_arm_file_states_is_refused(arm_of, bus, key, sub, found):
    with Link(arm_of(joint={"identity": {key: 0x1234}}), bus) as link:
        with pytest.raises(
            Refused, match=rf"joint_1 \(node 1\): .*1018h:0{sub} .* is {found}, expected 0x1234"
        ) as caught:
            link.start()
        assert "connect the right arm, or correct `identity` or `eds` of this joint under link.joints" in str(
            caught.value
        )
    assert not [data for can_id, data in bus.sent if can_id == 0x601 and data[0] & 0xE0 == 0x20]  # nothing was written


def test_an_identity_that_no_device_has_is_bad_input(arm_of):
    with pytest.raises(BadInput, match=r"identity\.serial"):
        arm_of(joint={"identity": {"serial": 2**32}})
    with pytest.raises(BadInput, match="unknown key"):
        arm_of(joint={"identity": {"maker": 1}})


def test_scan_shows_another_controller(tmp_path, capsys):
    content = yaml.safe_load(bundled_arms()["sarcos"].read_text())
    content["link"]["joints"][2]["identity"] = {"product": 7}
    path = tmp_path / "other.yaml"
    path.write_text(yaml.safe_dump(content))
    assert run(["scan", str(path), "--bus", "armlink_sim:sarcos"]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert "joint_3 (node 3): not the drive in the arm file: 1018h:02 product code is 0x41524d4c" in last


def test_scan_shows_a_node_id_given_twice(capsys, monkeypatch):
    put = LockStepBus.put

    def twice(self, can_id, data):
        put(self, can_id, data)
        if can_id == 0x604 and bytes(data[1:3]) == b"\x00\x10":
            put(self, can_id, data)

    monkeypatch.setattr(LockStepBus, "put", twice)
    assert run(["scan", "--bus", "armlink_sim:sarcos"]) == 3
    assert "node 4 answers twice: give every drive its own id" in capsys.readouterr().err.splitlines()[-1]


# ---- modes


def test_a_mode_that_a_controller_refuses_is_a_fault_after_the_deadline(enabled, bus):
    bus.nodes[2].modes = (8,)
    cycle, says = cycles_until_fault(enabled, command(TORQUE))
    assert cycle in (25, 26)  # 100 ms of 4 ms cycles after the one that commanded it
    assert says.startswith("joint_2: refuses mode 10 (cyclic synchronous torque): its mode display 6061h is 8")
    assert all_stopped(bus)


def test_a_mode_that_is_left_by_itself_is_a_fault_at_once(enabled, bus):
    for _ in range(30):
        enabled.cycle(command(TORQUE))
    bus.nodes[3].display = 0
    cycle, says = cycles_until_fault(enabled, command(TORQUE))
    assert cycle == 0
    assert "joint_3: refuses mode 10" in says


def test_a_joint_that_does_not_display_position_control_is_not_enabled(link, bus):
    bus.nodes[1].modes = ()
    link.start()
    with pytest.raises(BusFault, match=r"joint_1: refuses mode 8 \(cyclic synchronous position\)"):
        link.enable()


def test_a_mode_that_a_controller_does_not_have_is_refused_before_it_is_sent(enabled, bus):
    bus.sent.clear()
    with pytest.raises(
        Refused, match=r"gate: joint_1: mode 4 is not supported: the drive of this joint has the modes 8, 10"
    ):
        enabled.cycle(command(PROFILE_TORQUE))
    assert not [data for can_id, data in bus.sent if can_id & 0x780 == 0x300]
    assert all_stopped(bus)


def run_simulated(mode, torque=None, position=None, seconds=1.0):
    """A joint of the simulated arm in a profile mode; what it does."""
    arm = load_arm("sarcos")
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        sample = link.enable()
        given = Command.hold(sample.position)
        for _ in range(50):
            sample = link.cycle(given)
        given.mode[6] = mode
        given.torque[6] = np.nan if torque is None else torque
        given.position[6] = np.nan if position is None else sample.position[6] + position
        start, largest = sample.position[6], 0.0
        for _ in range(round(seconds * link.rate)):
            sample = link.cycle(given)
            if np.isfinite(sample.velocity[6]):
                largest = max(largest, abs(sample.velocity[6]))
        displays = link.groups[0].drives.known.displays[6]
        return sample.position[6] - start, largest, displays, arm.require_link().joints[6]


def test_profile_position_goes_to_its_target():
    moved, largest, display, joint = run_simulated(PROFILE_POSITION, position=0.2, seconds=2.0)
    assert display == PROFILE_POSITION
    assert moved == pytest.approx(0.2, abs=0.01)
    assert largest < 1.5 * joint.max_velocity


def test_profile_torque_is_the_torque():
    moved, _, display, _ = run_simulated(PROFILE_TORQUE, torque=0.0, seconds=0.1)
    assert display == PROFILE_TORQUE
    assert 0.01 < abs(moved) < 0.3  # without torque it begins to fall, and slowly at first


# ---- restarts


def test_a_restart_is_noticed_in_its_cycle_even_where_a_heartbeat_follows(enabled, bus):
    bus.out.extend([(0x703, b"\x00"), (0x703, b"\x7f")])
    bus.sent.clear()
    cycle, says = cycles_until_fault(enabled, command(POSITION))
    assert cycle == 0
    assert says.startswith("joint_3: its drive has restarted (boot-up message)")
    words = [struct.unpack("<Hhi", data)[0] for can_id, data in bus.sent if can_id & 0x780 == 0x200]
    assert set(words) == {0x02}  # in the very cycle in which it came: no frame enables a joint any more


def test_a_restarted_controller_is_not_enabled_before_it_is_set_up_again(enabled, bus):
    bus.out.append((0x703, b"\x00"))
    cycles_until_fault(enabled, command(POSITION))
    with pytest.raises(BusFault, match="joint_3: its drive has restarted"):
        enabled.enable()
    enabled.start()
    enabled.enable()
    enabled.cycle(command(POSITION))


def test_the_simulated_arm_restarting_under_way_is_noticed():
    arm = load_arm("sarcos")
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        given = Command.hold(link.enable().position)
        for _ in range(20):
            link.cycle(given)
        simulated.on_frame(0x000, bytes([0x81, simulated.nodes[2].node_id]))
        with pytest.raises(BusFault, match=r"joint_3: its drive has restarted"):
            link.cycle(given)
        stopped = [node.value(0x6041) & 0x6F for node in simulated.nodes]
    assert [word for place, word in enumerate(stopped) if place != 2] == [QUICK_STOP] * 6
    assert stopped[2] & 0x4F == SWITCH_ON_DISABLED


# ---- the bus


@pytest.mark.parametrize(
    ("can_id", "data", "what"),
    [
        (0x080, b"", "SYNC (080h)"),
        (0x000, b"\x01\x00", "NMT command (000h)"),
        (0x202, bytes(8), "RPDO1 of node 2 (202h)"),
        (0x303, b"\x08", "RPDO2 of node 3 (303h)"),
        (0x77F, b"\x05", "heartbeat of the host (77Fh)"),
        (0x402, bytes(8), "RPDO3 of node 2 (402h)"),
        (0x503, b"\x0f\x00", "RPDO4 of node 3 (503h)"),
        (0x602, b"\x2b\x40\x60\x00\x0f\x00\x00\x00", "SDO write of 6040h to node 2 (602h)"),
        (0x603, b"\xc2\x7a\x60\x00\x04\x00\x00\x00", "SDO write of 607Ah to node 3 (603h)"),
        (0x7E5, b"\x11\x05\x00\x00\x00\x00\x00\x00", "LSS command (7E5h)"),
    ],
)
def test_a_second_host_stops_all_in_the_cycle_in_which_it_is_heard(enabled, bus, can_id, data, what):
    bus.out.append((can_id, data))
    bus.sent.clear()
    cycle, says = cycles_until_fault(enabled, command(POSITION))
    assert cycle == 0
    assert says == (
        f"another host is on this bus: it sends {what}: stop that program, since only one program may command an arm"
    )
    words = [struct.unpack("<Hhi", data)[0] for can_id, data in bus.sent if can_id & 0x780 == 0x200]
    assert set(words) == {0x02}


def test_reading_along_is_not_commanding(enabled, bus):
    """Another tool may read objects: armlink scan beside a running host."""
    for node in range(1, 128):
        bus.out.append((0x600 + node, b"\x40\x00\x10\x00\x00\x00\x00\x00"))
    for _ in range(20):
        enabled.cycle(command(POSITION))


def test_a_torque_calibration_may_be_written_by_another_program(enabled, bus):
    bus.out.append((0x602, b"\x23\x00\x21\x04\x00\x00\x80\x3f"))
    bus.out.append((0x602, b"\x23\x10\x10\x04save"))
    for _ in range(5):
        enabled.cycle(command(POSITION))


def test_rpdos_that_are_not_ours_are_disabled(arm_of, bus):
    valid = {index: 0x80 * (index - 0x13FC) for index in (0x1402, 0x1403)}
    for node in bus.nodes.values():
        node.values |= {(index, 1): struct.pack("<I", base + node.node) for index, base in valid.items()}
    with Link(arm_of(), bus) as link:
        link.start()
    for node in bus.nodes.values():
        for index, base in valid.items():
            assert struct.unpack("<I", node.values[index, 1])[0] == 0x80000000 | base + node.node


def test_an_rpdo_that_stays_valid_is_refused(arm_of, bus):
    class Stubborn(dict):
        def __setitem__(self, key, value):
            if key != (0x1402, 1):
                super().__setitem__(key, value)

    bus.nodes[2].values = Stubborn(bus.nodes[2].values | {(0x1402, 1): struct.pack("<I", 0x402)})
    with (
        Link(arm_of(), bus) as link,
        pytest.raises(BusFault, match=r"joint_2 \(node 2\): 1402h:01 RPDO3 COB-ID: stays valid"),
    ):
        link.start()


@pytest.mark.parametrize(("age", "delay"), [(None, 0.05), (0.06, 0.02)])
def test_a_command_that_ages_between_gate_and_bus_does_not_leave(enabled, bus, age, delay):
    """As where the host is suspended for a while just before it sends: `delay` for each of three frames [s]."""
    drives = enabled.groups[0].drives
    frames = drives.frames

    def slow(orders, now):
        bus.clock.time += 3 * delay
        return frames(orders, now)

    given = command(POSITION)
    given.t = None if age is None else bus.clock.time - age
    drives.frames = slow
    bus.sent.clear()
    with pytest.raises(
        HostLate, match=r"the host was \d+ ms late .*; the command became too old before its frames were sent"
    ):
        enabled.cycle(given)
    words = [struct.unpack("<Hhi", data)[0] for can_id, data in bus.sent if can_id & 0x780 == 0x200]
    assert set(words) == {0x02}


def test_a_node_id_given_twice_is_found_after_three_cycles(enabled, bus):
    sync = bus._sync

    def twin(node):
        sync(node)
        if node.node == 2:
            bus.out.append((0x182, struct.pack("<ii", node.position + 5, node.torque)))

    bus._sync = twin
    cycle, says = cycles_until_fault(enabled, command(POSITION))
    assert cycle == 3
    assert says == (
        "joint_2: two readings come in every cycle, so a second node has the same id: give every node its own id"
    )
    assert all_stopped(bus)


def test_a_frame_that_comes_late_once_is_no_twin(enabled, bus):
    for _ in range(40):
        bus.out.append((0x182, struct.pack("<ii", 5, 5)))
        enabled.cycle(command(POSITION))
        enabled.cycle(command(POSITION))


def test_a_node_that_catches_up_two_readings_a_cycle_is_no_twin(enabled, bus):
    """As a controller, or a simulated arm, that was not given its time: every reading belongs to a SYNC of ours."""
    sync, late = bus._sync, []

    def slow(node):
        before = len(bus.out)
        sync(node)
        if node.node == 2 and lagging:
            late.extend(frame for frame in list(bus.out)[before:] if frame[0] == 0x182)
            for frame in late:
                with contextlib.suppress(ValueError):
                    bus.out.remove(frame)
        elif node.node == 2 and late:
            bus.out.append(late.pop(0))

    bus._sync = slow
    for _ in range(3):
        lagging = True
        for _ in range(8):
            enabled.cycle(command(POSITION))
        lagging = False
        for _ in range(10):
            enabled.cycle(command(POSITION))
        assert not late


def test_a_node_that_babbles_is_found(enabled, bus):
    def babble():
        bus.out.extend([(0x555, bytes(8))] * 100)

    cycle, says = cycles_until_fault(enabled, command(POSITION), babble)
    assert cycle <= 11
    assert says == (
        "the bus carries more frames than these joints send, most of them 555h: a node babbles, disconnect this node"
    )
    assert all_stopped(bus)


def test_a_bus_that_never_falls_silent_does_not_hold_the_host(enabled, bus):
    bus.nodes[2].no_tpdo = True
    enabled.commander.loop._port.receive = lambda timeout: bus.take(timeout) or (0x555, b"")
    assert "babbles" in cycles_until_fault(enabled, command(POSITION))[1]


def test_a_storm_of_emergencies_is_one_fault_and_costs_no_memory(enabled, bus):
    bus.out.extend((0x82, struct.pack("<HB5x", 0x7300 + i % 8, 0x20)) for i in range(900))
    cycle, says = cycles_until_fault(enabled, command(POSITION))
    assert cycle == 0
    assert says.startswith("joint_2: emergency 73")
    assert len(enabled.groups[0].drives.known.emergencies) <= 64
    assert all_stopped(bus)


def test_a_storm_of_error_resets_hides_no_error(enabled, bus):
    bus.out.append((0x81, struct.pack("<HB5x", 0x8611, 0x20)))
    bus.out.extend([(0x82, bytes(8))] * 500)
    assert cycles_until_fault(enabled, command(POSITION))[1].startswith("joint_1: emergency 8611h")


@pytest.mark.parametrize("can_id", [0x000, 0x080, 0x081, 0x582, 0x701, 0x7E4])
@pytest.mark.parametrize("data", [b"", b"\x00", b"\x80\x01"])
def test_frames_cut_short_raise_nothing_else(enabled, bus, can_id, data):
    bus.out.append((can_id, data))
    try:
        enabled.cycle(command(POSITION))
    except BusFault:
        assert all_stopped(bus)


# ---- entering power


def test_a_joint_that_holds_in_quick_stop_keeps_its_power_on_the_way_back(relinked, bus):
    for node in bus.nodes.values():
        node.commands.clear()
    relinked.enable()
    assert {word for node in bus.nodes.values() for word, *_ in node.commands} == {0x02, 0x0F}


def test_while_it_is_enabled_a_joint_keeps_its_target(link, bus):
    """A target that followed the reading would let the joint sag, cycle by cycle, under its load."""
    link.start()
    node, apply = bus.nodes[1], bus.nodes[1].apply

    def sagging():
        changed = apply()
        node.position -= 7
        return changed

    node.apply = sagging
    link.enable()
    targets = [position for word, _, position, _ in node.commands if word == 0x0F]
    assert len(targets) > 2
    assert len(set(targets[1:])) == 1
