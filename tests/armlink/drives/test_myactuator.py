"""MyActuator RMD-X drives: examples of the maker's manual (V4.2), keys, errors, restarts, and what is told of them."""

import math
import re

import pytest
from bench import Bench

from armlink.arm_file import load_arm, parse_arm
from armlink.drives.family import family
from armlink.drives.myactuator import frames
from armlink.drives.myactuator.frames import CURRENT, RmdCommand, request
from armlink.drives.orders import Mode, Power
from armlink.errors import BadInput, BusFault
from sim_bus.drives.fronts import simulated_families
from sim_bus.drives.motor import Motor


def hexed(text):
    return bytes.fromhex(text)


# ---- examples of the manual, sections 2.12 to 2.32


def test_commands_of_the_manual():
    assert frames.pack_torque(100) == hexed("A100000064000000")
    assert frames.pack_torque(-100) == hexed("A10000009CFF0000")
    assert frames.unpack_torque(hexed("A10000009CFF0000")) * CURRENT == -1.0
    assert frames.pack_position(36000, 500) == hexed("A400F401A08C0000")
    assert frames.pack_position(-36000, 500) == hexed("A400F4016073FFFF")
    assert frames.unpack_position(hexed("A400F4016073FFFF")) == (-36000, 500)
    assert frames.timeout_command(1000) == hexed("B3000000E8030000")
    assert request(RmdCommand.OFF) == hexed("8000000000000000")


def test_replies_of_the_manual():
    assert frames.unpack_angle(hexed("92000000A08C0000")) == pytest.approx(math.tau)
    forward, back = (frames.unpack_state(hexed(text)) for text in ("A1326400F4012D00", "A1329CFF0CFED3FF"))
    assert forward == pytest.approx((50.0, 1.0, math.radians(500)))
    assert back == pytest.approx((50.0, -1.0, math.radians(-500)))
    assert frames.unpack_error(hexed("9A320001E5010400")) == (50.0, 4)
    assert frames.error_text(4) == "low voltage (error 0004h)"
    assert frames.error_text(0x16) == "motor stall, low voltage, overcurrent (error 0016h)"
    assert frames.error_text(0x8000) == "unknown (error 8000h)"
    assert frames.unpack_count(hexed("B10000000000" + "0010")) == 268435456
    assert frames.unpack_count(hexed("B20000002E893401")) == 20220206
    assert frames.unpack_model(hexed("B558385332563130")) == "X8S2V10"


DRIVE = {"family": "myactuator", "id": 1, "model": "X8-25", "timeout_ms": 100}


def arm_of(tmp_path, *drives):
    names = [f"j{place}" for place in range(len(drives))]
    rows = [
        {"name": name, "drive": drive, "rated_torque": 10.0, "max_torque": 20.0}
        for name, drive in zip(names, drives, strict=True)
    ]
    joints = [{"name": name, "a": 0.1, "lower": -2.0, "upper": 2.0} for name in names]
    link = {"mass": 0.5, "com": [0.05, 0.0, 0.0], "inertia": [1e-3] * 3}
    content = {"name": "pair", "kinematics": {"joints": joints}, "link": {"joints": rows}}
    return parse_arm(content | {"sim": {"links": [link] * len(drives)}}, tmp_path / "pair.yaml")


class Still:
    """A motor that tells of the manual's example: 45° and 500 °/s, while 1 A flows."""

    joint, rated_torque, ratio, powered, heating = 0, 10.0, 1.0, True, 17.0
    position, velocity = math.radians(45), 0.0
    torque = 10.0 / 3.2
    tuned = (40.0, 4.0, 100.0)
    pace = Motor.pace

    def __init__(self):
        self.laws = []

    def impede(self, *law):
        self.laws.append(law)

    def free(self):
        self.laws.append(())

    def pass_time(self, now):
        pass


def test_the_simulated_drive_answers_the_manual_s_requests_with_its_replies(tmp_path):
    """Its coding is its own: neither side can be wrong as the other is."""
    arm, motor, sent = arm_of(tmp_path, DRIVE), Still(), []
    front = simulated_families()["myactuator"](
        arm, [(arm.link.joints[0], motor)], lambda can_id, data: sent.append((can_id, data))
    )
    front.drives[0]._was = (0.0, 0.0, math.radians(500))
    for asked, told in (
        ("A100000064000000", "A1326400F4012D00"),
        ("A400F401A08C0000", "A4326400F4012D00"),
        ("9C00000000000000", "9C326400F4012D00"),
        ("9200000000000000", "9200000094110000"),
        ("9A00000000000000", "9A320001E0010000"),
        ("7000000000000000", "7000000000000003"),
        ("B200000000000000", "B20000002E893401"),
        ("B500000000000000", "B558383235000000"),
        ("8000000000000000", "8000000000000000"),
        ("7000000000000000", "7000000000000000"),
        ("B3000000E8030000", "B3000000E8030000"),
    ):
        front.on_frame(0x141, hexed(asked))
        assert sent == [(0x241, hexed(told))], asked
        sent.clear()
    torque, position = motor.laws[:2]
    assert torque[4] == pytest.approx(10.0 / 3.2)  # one ampere
    assert position[3] > 0  # on its way, no faster than its torque allows
    assert front.drives[0].timeout == 1.0
    assert front.drives[0].flash_writes == 1
    front.on_frame(0x280, hexed("8000000000000000"))
    assert sent == [(0x241, hexed("8000000000000000"))]
    front.on_frame(0x141, hexed("76") + bytes(7))
    front.on_frame(0x142, hexed("92") + bytes(7))
    assert len(sent) == 1  # a reset is not answered, nor what is another's


# ---- keys


def test_the_torque_constant_is_rated_torque_over_rated_current_or_the_arm_file_s(tmp_path):
    arm = arm_of(tmp_path, DRIVE, {**DRIVE, "id": 2, "model": "", "torque_constant": 2.4})
    assert [joint.settings.constant for joint in arm.link.joints] == pytest.approx([3.125, 2.4])
    assert frames.torque_constant(frames.MOST_TORQUE) == max(frames.torque_constant(each) for each in frames.RATINGS)


@pytest.mark.parametrize(
    ("drives", "says"),
    [
        ([{**DRIVE, "model": "X9"}], "model 'X9' is unknown: give one of X4-3"),
        ([{**DRIVE, "id": 33}], "less than or equal to 32"),
        ([{**DRIVE, "torque_constant": 0.3}], "torque_constant 0.3 is that of the motor before the gear"),
        (
            [DRIVE, {"family": "canopen", "node": 0x41}],
            "j1: node 65 would read replies of the MyActuator drive 1 as",
        ),
    ],
)
def test_keys_that_cannot_be(tmp_path, drives, says):
    def build():
        arm = arm_of(tmp_path, *drives)
        family("myactuator").build(arm, [each for each in arm.link.joints if each.settings.family == "myactuator"])

    with pytest.raises(BadInput, match=re.escape(says)):
        build()


# ---- what is found out


def test_another_model_than_the_arm_file_states_is_told():
    bench = Bench("six-myactuator")
    bench.simulated[2].model = "X625"
    bench.simulated[3].model = "X1040"
    found = bench.drives.identify(bench)
    assert [each.mismatch for each in found] == [*[""] * 3, "the arm file states model X6-7", "", ""]
    assert (found[0].name, found[0].firmware) == ("MyActuator X1040", "20220206")


def test_the_set_up_writes_nothing_and_says_what_the_drive_cannot_tell(tmp_path):
    bench = Bench(arm_of(tmp_path, {**DRIVE, "timeout_ms": 0}))
    notes = bench.set_up()[0].notes
    assert "141#B300000064000000" in notes[0]
    assert bench.drives.traits(0).silence == "keeps on"
    assert not {data[0] for _, data in bench.log} & {0xB3, 0x20, 0x43, 0x63, 0x64}


def test_a_drive_that_plans_its_own_way_is_noted(tmp_path):
    bench = Bench(arm_of(tmp_path, DRIVE))
    drive = bench.simulated[0]
    receive = drive.receive
    drive.receive = lambda can_id, data: (
        drive._reply(hexed("4200000010270000")) if data[0] == 0x42 else receive(can_id, data)
    )
    assert "with 10000 °/s²" in bench.set_up()[0].notes[2]


def test_a_drive_without_an_answer():
    bench = Bench("six-myactuator")
    bench.simulated[1].unplugged = True
    with pytest.raises(BusFault, match="shoulder: no answer from id 2"):
        bench.set_up()


def test_an_error_is_told_and_no_walk_leads_over_it():
    bench = Bench("six-myactuator")
    bench.simulated[1].inject("drive.latched", 0.0)
    bench.set_up()
    assert not bench.walk()
    assert "shoulder (id 2): motor stall (error 0002h)" in str(bench.drives.fault([0] * 6, bench.arm.time))
    assert bench.powered == [True, False, True, True, True, True]
    bench.simulated[1].reboot()
    bench.simulated[1].end_faults()
    bench.drives.forget(restarts=True)
    assert bench.walk()


def test_a_drive_that_restarted_is_not_led_on_by_another_zero():
    bench = Bench("six-myactuator")
    bench.set_up()
    bench.walk()
    for _ in range(100):
        bench.cycle([bench.order(j) for j in range(6)])
    bench.simulated[1].reboot()
    began = bench.arm.time
    while not bench.drives.has_restarted(1) and bench.arm.time < began + 1.0:
        bench.cycle([bench.order(j) for j in range(6)])
    assert bench.arm.time - began < 2 * 6 * bench.period + 1e-9
    assert "shoulder (id 2): has restarted" in str(bench.drives.fault([Mode.POSITION] * 6, bench.arm.time))
    assert not bench.walk()
    assert not bench.powered[1]
    bench.drives.forget(restarts=True)
    bench.set_up()
    assert bench.walk()


def test_a_torque_for_all_drives_is_no_order_and_a_switching_is():
    drives = Bench("six-myactuator").drives
    assert drives.command_of(0x280, frames.pack_torque(100)) is None
    joint, order = drives.command_of(0x280, request(RmdCommand.OFF))
    assert (joint, order.power) == (-1, Power.OFF)
    assert drives.command_of(0x141, request(RmdCommand.STATUS)) is None


def test_the_speed_of_a_way_is_limited_in_the_frame():
    bench = Bench("six-myactuator")
    bench.set_up()
    bench.walk()
    data = [data for can_id, data in bench.cycle([bench.order(j) for j in range(6)]) if data[0] == 0xA4]
    most = load_arm("six-myactuator").link.joints[0].max_velocity
    assert {frames.unpack_position(each)[1] for each in data} == {math.ceil(math.degrees(most))}


def test_a_drive_is_switched_on_where_the_gate_has_it_stand_and_not_where_a_false_reading_does():
    """12,385 rad in 92h; found by a property test, which sees the bytes without the link's gate."""
    bench = Bench("six-myactuator")
    bench.set_up()
    bench.drives.take(0x241, hexed("920000004E03D03A"), bench.arm.time)
    orders = [bench.order(j, walk=True, position=0.3 if j == 0 else None) for j in range(6)]
    sent = dict(reversed(bench.drives.frames(orders, bench.arm.time)))
    assert bench.drives.memory[0].position > 1e4
    assert frames.unpack_position(sent[0x141])[0] == round(math.degrees(0.3) * 100)
