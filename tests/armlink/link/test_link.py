"""The link on scripted nodes: what it sends, byte for byte, and how it leaves the joints."""

import signal
import struct

import numpy as np
import pytest

from armlink.drives.orders import Power
from armlink.errors import BadInput, BusFault, Refused
from armlink.link.cycle import Commander
from armlink.link.link import Link
from armlink.link.types import Calibration, Command

SWITCH_ON_DISABLED, ENABLED, QUICK_STOP, FAULT = 0x40, 0x27, 0x07, 0x08
OFF, POSITION, TORQUE = 0, 8, 10


def command(mode, torque=0.0, position=0.0, n=3, t=None):
    return Command(np.full(n, mode, np.int8), np.full(n, torque), np.full(n, position), t)


def sdo_writes(bus, node):
    """(index, sub, value) of each expedited SDO download to a node, in order (CiA 301 section 7.2.4.3.3)."""
    return [
        (*struct.unpack_from("<HB", data, 1), int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little"))
        for can_id, data in bus.sent
        if can_id == 0x600 + node and data[0] & 0xE0 == 0x20
    ]


def test_scan_tells_who_is_there(link, bus):
    bus.nodes[2].silent = True
    first, second, third = link.scan()
    assert (first.joint, first.address, first.present, first.serial) == (0, "node 1", True, "11:22:33:101")
    assert first.power is Power.OFF
    assert (second.joint, second.address, second.present) == (1, "node 2", False)
    assert third.present


def test_a_missing_node_is_named(link, bus):
    bus.nodes[2].silent = True
    with pytest.raises(BusFault, match=r"no answer from joint_2 \(node 2\) on fake") as caught:
        link.start()
    assert caught.value.exit_status == 3


def test_pdos_are_configured_in_the_order_of_the_standard(link, bus):
    link.start()
    # CiA 301 7.5.2.36: COB-ID invalid, count 0, entries, count, COB-ID valid.
    # RPDO1 carries 6040h with 16 bits, 6071h with 16, 607Ah with 32.
    writes = [write for write in sdo_writes(bus, 2) if write[0] in (0x1400, 0x1600)]
    assert writes == [
        (0x1400, 1, 0x80000202),
        (0x1600, 0, 0),
        (0x1400, 2, 1),
        (0x1400, 5, 100),
        (0x1600, 1, 0x60400010),
        (0x1600, 2, 0x60710010),
        (0x1600, 3, 0x607A0020),
        (0x1600, 0, 3),
        (0x1400, 1, 0x00000202),
    ]
    writes = [write for write in sdo_writes(bus, 3) if write[0] in (0x1800, 0x1A00)]
    assert writes[-3:] == [(0x1A00, 2, 0x21000120), (0x1A00, 0, 2), (0x1800, 1, 0x40000183)]


def test_the_device_gets_limits_that_hold_without_the_host(link, bus):
    link.start()
    writes = {(index, sub): value for index, sub, value in sdo_writes(bus, 1)}
    assert writes[0x6072, 0] == 750  # 30 N·m of 40 N·m rated
    window = (2.0 + 0.02 * 2.0 + 0.05) / (2 * np.pi) * 2**20
    assert writes[0x607D, 2] == int(window)
    assert writes[0x607D, 1] == 2**32 - int(window)
    assert writes[0x1016, 1] == 127 << 16 | 200  # the highest free node id is the host; twice the deadline
    assert writes[0x1017, 0] == 50
    assert writes[0x6007, 0] == 3
    assert writes[0x605A, 0] == 6
    assert (writes[0x60C2, 1], writes[0x60C2, 2]) == (4, 0xFD)  # 4 · 10^-3 s


def test_a_device_that_holds_another_mapping_is_refused(link, bus):
    bus.nodes[3].mapping_lies = True
    expected = r"joint_3 \(node 3\): 1A00h:02 TPDO1 mapping 2: 0x21000120 was written, but the device holds 0x60770010"
    with pytest.raises(BusFault, match=expected):
        link.start()


def test_another_rated_torque_than_the_arm_file_is_refused(link, bus):
    bus.nodes[1].values[0x6076, 0] = struct.pack("<I", 38_000)
    with pytest.raises(
        BadInput, match=r"joint_1 \(node 1\): rated torque 6076h is 38.0 N·m, but the arm file has 40.0"
    ):
        link.start()


def test_a_device_without_torque_mode_is_refused(link, bus):
    bus.nodes[1].values[0x6502, 0] = struct.pack("<I", 1 << 7)
    with pytest.raises(BusFault, match=r"joint_1 \(node 1\): mode 10 .*not supported: 6502h is 0x80"):
        link.start()


def test_a_refused_sdo_names_joint_and_object(link, bus):
    del bus.nodes[2].values[0x6092, 1]
    with pytest.raises(BusFault, match=r"joint_2 \(node 2\): 6092h:01 feed: read refused: .*0x06020000"):
        link.start()


def test_enable_walks_the_states_and_holds_where_the_joint_stands(link, bus):
    bus.nodes[1].position = 12345
    link.start()
    sample = link.enable()
    walked = [control for control, *_ in bus.nodes[1].commands]
    assert [word for word, before in zip(walked, [None, *walked], strict=False) if word != before] == [0, 6, 7, 15]
    assert {position for _, _, position, _ in bus.nodes[1].commands[3:]} == {12345}
    assert sample.position[0] == pytest.approx(12345 * 2 * np.pi / 2**20)
    assert bus.nodes[1].status == ENABLED


def test_enable_resets_a_fault_by_a_rising_edge(link, bus):
    bus.nodes[2].status = FAULT
    link.start()
    link.enable()
    assert bus.nodes[2].status == ENABLED


def test_a_joint_that_will_not_enable_is_named(link, bus):
    link.start()
    bus.nodes[3].apply = lambda: False
    with pytest.raises(
        BusFault, match=r'joint_3: stays in state "switch on disabled" and does not reach "operation enabled" within 3'
    ):
        link.enable()


def test_a_cycle_is_rpdos_then_sync_and_one_sample(enabled, bus):
    bus.sent.clear()
    bus.nodes[2].torque = -1_234_567
    sample = enabled.cycle(command(POSITION, position=0.001))
    ids = [can_id for can_id, _ in bus.sent if can_id != 0x700 + 127]
    assert ids == [0x201, 0x202, 0x203, 0x80]
    units = round(0.001 / (2 * np.pi) * 2**20)
    assert bus.sent[0][1] == struct.pack("<Hhi", 15, 50, units)  # in position mode 6071h follows the produced 50 ‰
    np.testing.assert_allclose(sample.position, units * 2 * np.pi / 2**20)
    assert sample.torque[1] == pytest.approx(-1.234567)
    assert sample.age.tolist() == [0, 0, 0]
    assert enabled.position_sent[0] == pytest.approx(0.001, abs=6e-6)


def test_slow_readings_are_nan_in_the_cycles_that_bring_none(enabled):
    samples = [enabled.cycle(command(POSITION)) for _ in range(8)]
    came = [bool(np.isfinite(sample.motor_torque).all()) for sample in samples]
    assert sum(came) == 2
    assert came[4:] == came[:4]
    assert all(np.isnan(sample.velocity).all() != here for sample, here in zip(samples, came, strict=True))
    assert samples[came.index(True)].motor_torque[0] == pytest.approx(2.0)  # 50 ‰ of 40 N·m


def test_torque_mode_starts_from_the_torque_now_produced(enabled, bus):
    bus.nodes[1].motor = 200  # 8 N·m hold a load
    for _ in range(5):
        enabled.cycle(command(POSITION))
    bus.nodes[1].commands.clear()
    for _ in range(80):
        enabled.cycle(command(TORQUE, torque=0.0))
    sent = [torque for _, torque, _, mode in bus.nodes[1].commands if mode == TORQUE]
    # 8 N·m less steps of 200 N·m/s · 4 ms = 20 counts, of which each cycle within the first 0.5 s allows a share more
    eased = np.maximum(200 - 20 * np.cumsum(np.arange(1, 81) * 0.004 / 0.5), 0.0)
    assert sent == pytest.approx(eased, abs=1)
    assert sent[-1] == 0


def test_position_mode_starts_from_the_measured_position(enabled, bus):
    for _ in range(5):
        enabled.cycle(command(TORQUE, torque=1.0))
    bus.nodes[1].position = 1_000  # the load moved the joint, no faster than a joint can
    enabled.cycle(command(TORQUE, torque=1.0))
    bus.nodes[1].commands.clear()
    enabled.cycle(command(POSITION, position=0.0))
    _, _, position, mode = bus.nodes[1].commands[-1]
    assert mode == POSITION
    assert position == pytest.approx(1_000 - 1.0 * 0.004 / (2 * np.pi) * 2**20, abs=1)


def test_mode_frames_are_sent_only_when_the_mode_changes(enabled, bus):
    bus.sent.clear()
    for mode in (POSITION, POSITION, TORQUE, TORQUE, TORQUE, POSITION):
        enabled.cycle(command(mode))
    assert [(can_id, data) for can_id, data in bus.sent if can_id & 0x780 == 0x300 and can_id & 0x7F == 2] == [
        (0x302, b"\x0a"),
        (0x302, b"\x08"),
    ]


def test_the_host_sends_its_heartbeat_from_the_loop(enabled, bus):
    bus.sent.clear()
    for _ in range(24):
        enabled.cycle(command(POSITION))
    beats = [data for can_id, data in bus.sent if can_id == 0x77F]
    assert beats == [b"\x05"] * 2  # every 12 cycles of 4 ms: half of the 100 ms deadline


def test_leaving_normally_or_by_an_exception_is_a_quick_stop(arm_of, bus):
    for error in (None, RuntimeError, KeyboardInterrupt):
        try:
            with Link(arm_of(), bus) as link:
                link.start()
                link.enable()
                link.cycle(command(TORQUE, torque=5.0))
                if error:
                    raise error
        except (RuntimeError, KeyboardInterrupt):
            pass
        assert [node.status for node in bus.nodes.values()] == [QUICK_STOP] * 3
        assert bus.closed


def test_an_interruption_while_leaving_is_a_quick_stop_too(arm_of, bus, monkeypatch):
    stop = Commander.stop

    def interrupted(commander: Commander) -> None:
        signal.raise_signal(signal.SIGINT)
        stop(commander)

    monkeypatch.setattr(Commander, "stop", interrupted)
    link = Link(arm_of(), bus)
    link.start()
    link.enable()
    link.cycle(command(TORQUE, torque=5.0))
    link.__exit__(None, None, None)
    assert [node.status for node in bus.nodes.values()] == [QUICK_STOP] * 3
    assert bus.closed


def test_a_joint_in_quick_stop_is_enabled_without_losing_power(relinked, bus):
    bus.nodes[1].commands.clear()
    relinked.enable()
    controls = [control for control, *_ in bus.nodes[1].commands]
    assert controls[-1] == 15
    assert bus.nodes[1].status == ENABLED


def test_disable_takes_the_power_and_leaving_changes_nothing_more(arm_of, bus):
    with Link(arm_of(), bus) as link:
        link.start()
        link.enable()
        link.disable()
        assert [node.status for node in bus.nodes.values()] == [SWITCH_ON_DISABLED] * 3
        bus.sent.clear()
    assert bus.sent == []


def test_a_refused_command_stops_the_joint_in_the_same_cycle(enabled, bus):
    bad = command(TORQUE)
    bad.torque[1] = np.nan
    bus.sent.clear()
    with pytest.raises(Refused, match=r"gate: joint_2: target torque is nan, expected a finite number") as caught:
        enabled.cycle(bad)
    assert caught.value.exit_status == 1
    first = {can_id: struct.unpack("<Hhi", data)[0] for can_id, data in reversed(bus.sent) if can_id & 0x780 == 0x200}
    assert first == {0x201: 15, 0x202: 2, 0x203: 15}
    assert [node.status for node in bus.nodes.values()] == [QUICK_STOP] * 3


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (command(POSITION, position=np.inf), "joint_1: target position is inf"),
        (command(9), "joint_1: mode 9, expected 0"),
        (command(POSITION, t=-1e3), "the command is .* ms old: it must be 0 to 100 ms old"),
        (command(POSITION, t=1e9), "the command is -.* ms old"),
    ],
)
def test_what_the_gate_refuses(enabled, bad, says):
    with pytest.raises(Refused, match=says):
        enabled.cycle(bad)


def test_cycle_before_enable_is_refused(link):
    with pytest.raises(BusFault, match="not enabled"):
        link.cycle(command(POSITION))
    with pytest.raises(BusFault, match="not started"):
        link.enable()


def test_an_mode_off_joint_is_switched_off_and_no_fault(enabled, bus):
    for _ in range(8):
        enabled.cycle(Command(np.array([POSITION, OFF, POSITION], np.int8), np.zeros(3), np.zeros(3)))
    assert [node.status for node in bus.nodes.values()] == [ENABLED, SWITCH_ON_DISABLED, ENABLED]


def test_calibration_is_staged_checked_and_made_active(enabled, bus):
    bus.sent.clear()
    held = enabled.write_calibration(1, Calibration(1.05, -0.25, record_id=7, date=1_700_000_000))
    writes = [(index, sub) for index, sub, _ in sdo_writes(bus, 2)]
    assert writes == [(0x2100, 4), (0x2100, 5), (0x2100, 7), (0x2100, 8), (0x2100, 9), (0x2100, 6)]
    assert held.gain == np.float32(1.05)
    assert held.offset == -0.25
    assert (held.record_id, held.date) == (7, 1_700_000_000)
    assert enabled.read_calibration(1) == held
    assert enabled.read_calibration(0).gain == 1.0
    assert bus.nodes[2].status == ENABLED


def test_storing_to_flash_only_on_request(enabled, bus):
    enabled.write_calibration(0, Calibration(1.0, 0.0, record_id=1), store=True)
    assert (0x1010, 4, 0x65766173) in sdo_writes(bus, 1)
    assert not [write for write in sdo_writes(bus, 2) if write[0] == 0x1010]


@pytest.mark.parametrize(("gain", "offset"), [(np.nan, 0.0), (0.0, 0.0), (-1.0, 0.0), (1.0, np.inf)])
def test_a_calibration_that_no_sensor_has_is_refused(enabled, gain, offset):
    with pytest.raises(BadInput, match="joint_1: "):
        enabled.write_calibration(0, Calibration(gain, offset, record_id=1))


def test_while_a_controller_thinks_the_cycle_goes_on(enabled, bus):
    """An SDO answer that takes 20 ms must not silence the commands that the other joints wait for."""
    node = bus.nodes[2]
    answer, late = node.sdo, []

    def slow(data):
        late.append((node.syncs + 5, answer(data)))

    node.sdo = slow
    sync = bus._sync

    def on_sync(each):
        sync(each)
        if each is node and late and node.syncs >= late[0][0]:
            bus.out.append((0x582, late.pop(0)[1]))

    bus._sync = on_sync
    before = enabled.stats.cycles
    assert enabled.read_calibration(1).gain == 1.0
    assert enabled.stats.cycles == before + 5 * 5
    assert enabled.stats.missed == 0


def test_stats_count_frames_and_load(enabled, bus):
    for _ in range(100):
        enabled.cycle(command(POSITION))
    stats = enabled.stats
    assert stats.rate_hz == pytest.approx(250)
    # a cycle: 3 RPDO, SYNC, 3 TPDO1, 3/4 TPDO2 (8 bytes: 111 bits, SYNC 47), 1/12 heartbeat (55 bits)
    bits = 3 * 111 + 47 + 3 * 111 + 0.75 * 111 + 55 / 12
    assert stats.load == pytest.approx(bits * 250 / 1e6, rel=0.02)
    assert stats.missed == stats.errors == 0
