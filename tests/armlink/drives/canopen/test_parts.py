"""Small parts: units, emergencies, PDO layouts, bus specifications, interpolation time."""

import math
from types import SimpleNamespace

import pytest

from armlink.arm_file import Bus
from armlink.bus.open import open_bus, parse_bus
from armlink.drives.canopen import eds_file as data_sheet
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import pdo
from armlink.drives.canopen.controller_setup import interpolation, reading_ranges
from armlink.drives.canopen.emcy import name_of, parse
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.units import Units, units_from
from armlink.errors import BadInput, BusFault, Refused


def test_units_of_a_geared_joint():
    # 40 N·m rated; 65536 increments a motor turn, gear 100:1, 2^20 user units a joint turn
    units = units_from(40_000, (65536, 1), (100, 1), (1 << 20, 1))
    assert units.torque == pytest.approx(0.04)
    assert units.position == pytest.approx(2 * math.pi / 1048576)
    assert units.encoder_step == pytest.approx(2 * math.pi / 6_553_600)


def test_units_with_a_feed_for_several_turns():
    assert units_from(1000, (4096, 2), (3, 2), (7200, 2)).position == pytest.approx(2 * math.pi / 3600)


@pytest.mark.parametrize("place", range(4))
def test_a_zero_among_the_scales_is_an_error(place):
    values = [40_000, (65536, 1), (100, 1), (1 << 20, 1)]
    values[place] = 0 if place == 0 else (0, 1)
    with pytest.raises(ValueError, match="a zero"):
        units_from(*values)


@pytest.mark.parametrize(
    ("code", "name"),
    [
        (0x0000, "no error"),
        (0x8130, "heartbeat of the host missing"),
        (0x7305, "incremental sensor"),
        (0x2213, "over-current in ramp function"),
        (0x2331, "earth leakage at the motor, phase U"),
        (0x3222, "DC link under-voltage, no. 2"),
        (0x5445, "contact 5 (manufacturer specific)"),
        (0x630F, "data record no. 15"),
        (0x8612, "reference limit"),
        (0x8699, "positioning controller"),
        (0x8F00, "monitoring"),
        (0x4501, "temperature"),
        (0x9010, "external error"),
        (0xF004, "control function"),
        (0xFF01, "manufacturer specific (torque sensor)"),
        (0xB000, "unknown error"),
    ],
)
def test_emergency_names(code, name):
    assert name_of(code) == name


# CiA 301, table of emergency error code classes: every one must have a name of its own.
CLASSES = (
    0x10, 0x20, 0x21, 0x22, 0x23, 0x30, 0x31, 0x32, 0x33, 0x40, 0x41, 0x42, 0x50, 0x60, 0x61, 0x62, 0x63, 0x70,
    0x80, 0x81, 0x82, 0x90, 0xF0, 0xFF,
)  # fmt: skip


def test_every_class_of_error_codes_has_its_name():
    names = [name_of(each << 8 | 0x9A) for each in CLASSES]
    assert len(set(names)) == len(CLASSES)
    assert "unknown error" not in names
    for code in range(1 << 16):
        assert name_of(code)


def test_emergency_frames():
    assert parse(bytes.fromhex("3081110000000000")) == (0x8130, 0x11)
    assert parse(b"\x30") == (0x1000, 0xFF)


def test_pdo_layouts_are_packed_little_endian():
    assert pdo.RPDO1.layout.pack(0x000F, -100, 0x01020304) == bytes.fromhex("0f009cff04030201")
    assert pdo.TPDO1.layout.unpack(bytes.fromhex("0400000000 f0ffff".replace(" ", ""))) == (4, -4096)
    assert pdo.TPDO2.layout.unpack(bytes.fromhex("2712ceff10000000")) == (0x1227, -50, 16)
    assert pdo.TPDO3.layout.size == 3
    assert pdo.RPDO2.layout.size == 1


def test_mapping_entries():
    assert objects.TORQUE_READING.mapping == 0x21000120
    assert objects.MODE.mapping == 0x60600008
    assert objects.MOTOR_TORQUE.mapping == 0x60770010


def test_every_object_that_the_link_uses_is_in_the_data_sheet_with_its_size():
    dictionary = data_sheet.bundled()
    entries = data_sheet.used_objects()
    assert len(entries) > 30
    for entry in entries:
        variable = dictionary.get_variable(entry.index, entry.sub)
        assert variable is not None, entry
        assert len(variable) == entry.bits, entry
    for each in pdo.LINK_PDOS:
        for entry in each.entries:
            assert dictionary.get_variable(entry.index, entry.sub).pdo_mappable, entry


@pytest.mark.parametrize(
    ("spec", "bus"),
    [
        ("socketcan:vcan0", ("socketcan", "vcan0", 1_000_000)),
        ("socketcan:vcan0@500000", ("socketcan", "vcan0", 500_000)),
        ("udp_multicast:239.74.163.2", ("udp_multicast", "239.74.163.2", 1_000_000)),
        ("slcan:/dev/tty:1@125000", ("slcan", "/dev/tty:1", 125_000)),
    ],
)
def test_bus_specifications(spec, bus):
    parsed = parse_bus(spec)
    assert (parsed.interface, parsed.channel, parsed.bitrate) == bus


@pytest.mark.parametrize(
    "spec", ["", "vcan0", "socketcan:", ":vcan0", "socketcan:vcan0@", "socketcan:vcan0@fast", "a:b@0"]
)
def test_malformed_bus_specifications_say_the_form(spec):
    with pytest.raises(BadInput, match=r"expected .*INTERFACE:CHANNEL\[@BITRATE\]"):
        parse_bus(spec)


def test_an_interface_that_nobody_knows_is_bad_input():
    with pytest.raises(BadInput, match="bus nonsense:x: "):
        open_bus("nonsense:x", Bus())


def test_a_bus_that_does_not_exist_is_a_bus_fault():
    with pytest.raises(BusFault, match="bus socketcan:nocan7: cannot open it: ") as caught:
        open_bus(None, Bus(channel="nocan7"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("rate", "value"),
    [(250, (4, -3)), (1000, (1, -3)), (400, (25, -4)), (500, (2, -3)), (800, (125, -5)), (5, (200, -3))],
)
def test_interpolation_time(rate, value):
    assert interpolation(1 / rate) == value


def test_interpolation_time_that_is_not_exact_is_within_a_percent():
    value, exponent = interpolation(1 / 333)
    assert 1 <= value <= 255
    assert value * 10.0**exponent == pytest.approx(1 / 333, rel=0.01)


class Device:
    """SDO access to a device that has these objects alone, by index and subindex."""

    def __init__(self, objects_held: dict[tuple[int, int], int]) -> None:
        self._held = objects_held

    def has(self, entry: Entry) -> bool:
        return (entry.index, entry.sub) in self._held

    def read(self, entry: Entry) -> int:
        return self._held[entry.index, entry.sub]


FAST = {(0x6080, 0): 3000, (0x6091, 1): 100, (0x6091, 2): 1}
"""3000 motor revolutions a minute behind a gear of 100: 3.14 rad/s."""


@pytest.mark.parametrize(
    ("held", "max_velocity", "refused"),
    [
        ({(0x607F, 0): 2000}, 1.9, ""),
        ({(0x607F, 0): 2000}, 2.0, ""),
        (
            {(0x607F, 0): 2000},
            2.1,
            "607Fh:00 max profile velocity is 2000, which is 2 rad/s, .* 2.1 rad/s: set the object to 2100 or",
        ),
        ({(0x607F, 0): 0}, 2.1, ""),  # 0: no limit of its own
        (FAST, 3.1, ""),
        (
            FAST,
            3.2,
            "6080h:00 max motor speed is 3000, which is 3.142 rad/s, .* 3.2 rad/s: set the object to "
            "3056 or more, or lower",
        ),
        ({(0x6080, 0): 3000}, 300.0, ""),  # without a gear: 314 rad/s
        ({}, 300.0, ""),
    ],
)
def test_a_device_that_turns_no_faster_than_asked_for_is_refused(held, max_velocity, refused):
    unit = Units(torque=0.04, position=1e-6, velocity=1e-3, encoder_step=1e-6)
    joint = SimpleNamespace(name="elbow", settings=SimpleNamespace(address="node 5"))
    profile = SimpleNamespace(has=lambda entry: True)
    limits = SimpleNamespace(max_velocity=max_velocity)
    if refused:
        with pytest.raises(Refused, match=rf"elbow \(node 5\): {refused}"):
            reading_ranges(Device(held), joint, unit, limits, profile)
    else:
        reading_ranges(Device(held), joint, unit, limits, profile)
