"""Frames of the drive families against bytes worked out from the makers' manuals, and against code that is not ours."""

import math
import struct
from itertools import islice
from types import SimpleNamespace

import can
import cantools
import pytest
from damiao_motor.core.motor import DaMiaoMotor, is_register_reply
from hypothesis import given
from hypothesis import strategies as st
from moteus import multiplex, protocol
from odrive_can import get_dbc
from robstride.client import Client
from TMotorCANControl.mit_can import CAN_Manager, MIT_Params

from armlink.drives.cubemars import frames as cubemars
from armlink.drives.damiao import frames as damiao
from armlink.drives.mit_packing import (
    MitCommand,
    MitFeedback,
    Ranges,
    Special,
    grid_of,
    pack_command,
    pack_feedback,
    special,
    special_of,
    unpack_command,
    unpack_feedback,
    unwrap,
)
from armlink.drives.moteus import frames as moteus
from armlink.drives.odrive import frames as odrive
from armlink.drives.robstride import frames as robstride

DM4340 = grid_of(Ranges(12.5, 10.0, 28.0))


# ---- MIT packing


def test_mit_command_by_hand():
    """q = 12.5 is all ones, dq = -10 zero, kp = 250 half of 4095, kd = 5 all ones, tau = 14 three quarters."""
    data = pack_command(MitCommand(12.5, -10.0, 250.0, 5.0, 14.0), DM4340)
    assert data.hex() == "ffff" + "000" + "800" + "fff" + "bff"
    assert unpack_command(data, DM4340) == pytest.approx((12.5, -10.0, 250.06, 5.0, 13.997), abs=0.004)


def test_zero_is_sent_as_the_nearest_step():
    """Truncation sends 7FFh for 0 N·m; 2047.5 lies between two steps, and half a step is as near as it goes."""
    sent = unpack_command(pack_command(MitCommand(0.0, 0.0, 0.0, 0.0, 0.0), DM4340), DM4340)
    assert abs(sent.torque) <= DM4340.ranges.torque / 0xFFF * 1.0001  # half a step
    small = pack_command(MitCommand(0.0, 0.0, 0.0, 0.0, -0.0001), DM4340)
    large = pack_command(MitCommand(0.0, 0.0, 0.0, 0.0, 0.0001), DM4340)
    assert (small[-2] & 0xF) << 8 | small[-1] == 0x7FF
    assert (large[-2] & 0xF) << 8 | large[-1] == 0x800


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_not_packed(wrong):
    for place in range(5):
        command = [0.0] * 5
        command[place] = wrong
        with pytest.raises(ValueError, match="finite"):
            pack_command(MitCommand(*command), DM4340)


@given(st.floats(-30, 30), st.sampled_from([12, 16]), st.floats(0.1, 100))
def test_rounding_is_to_the_nearest_step_and_ends_at_the_range(value, bits, most):
    grid = grid_of(Ranges(1.0, 1.0, most), (16, 12, 12, 12, bits))
    steps = grid.steps(MitCommand(0.0, 0.0, 0.0, 0.0, value))[4]
    quantum = 2 * most / (2**bits - 1)
    back = -most + steps * quantum
    assert abs(back - max(-most, min(most, value))) <= quantum / 2 * 1.0001


@given(st.binary(min_size=8, max_size=8))
def test_any_command_and_any_feedback_comes_back_as_the_same_bytes(data):
    assert pack_command(unpack_command(data, DM4340), DM4340) == data
    assert pack_feedback(unpack_feedback(data[:5], DM4340), DM4340) == data[:5]


def test_unwrapping_takes_the_nearest_turn():
    assert unwrap(-12.4, 12.45, 25.0) == pytest.approx(12.6)
    assert unwrap(12.4, -12.45, 25.0) == pytest.approx(-12.6)
    assert unwrap(1.0, 1.1, 25.0) == 1.0


# ---- Damiao


@given(st.tuples(st.floats(-12.5, 12.5), st.floats(-10, 10), st.floats(0, 500), st.floats(0, 5), st.floats(-28, 28)))
def test_damiao_commands_beside_the_stock_client(values):
    """It truncates where we round: at most one step apart, in every field."""
    q, dq, kp, kd, torque = values
    stock = DaMiaoMotor(1, 0x11, None, motor_type="4340")
    theirs = stock.encode_cmd_msg(q, dq, torque, kp, kd)
    ours = pack_command(MitCommand(*values), DM4340)
    for shift, bits in ((48, 16), (36, 12), (24, 12), (12, 12), (0, 12)):
        pair = [int.from_bytes(data, "big") >> shift & (1 << bits) - 1 for data in (ours, theirs)]
        assert pair[0] - pair[1] in (0, 1)


def test_damiao_reply_by_hand_and_by_the_stock_client():
    """State 1, id 2, q 8000h, dq 800h, tau C00h, 45 °C and 50 °C."""
    data = bytes.fromhex("12" + "8000" + "800" + "c00" + "2d" + "32")
    reply = damiao.unpack_reply(data, DM4340)
    assert (reply.drive, reply.state, reply.stage_temperature, reply.rotor_temperature) == (2, 1, 45, 50)
    assert reply.feedback == pytest.approx((0.00019, 0.00244, 14.0103), abs=1e-4)
    theirs = DaMiaoMotor(2, 0x12, None, motor_type="4340").decode_sensor_feedback(data)
    assert (theirs["pos"], theirs["vel"], theirs["torq"]) == pytest.approx(reply.feedback)
    assert damiao.pack_reply(reply, DM4340) == data
    assert damiao.unpack_reply(data[:7], DM4340) is None


def test_damiao_special_commands_and_registers_by_hand():
    assert special(Special.ENABLE).hex() == "fffffffffffffffc"
    assert special_of(bytes.fromhex("fffffffffffffffd")) is Special.DISABLE
    assert special_of(bytes.fromhex("ffffffffffffff00")) is None
    assert damiao.read_request(0x102, 21).hex() == "0201331500000000"
    assert damiao.write_request(2, 10, 1).hex() == "0200550a01000000"  # uint32
    assert damiao.write_request(2, 23, 28.0).hex() == "020055170000e041"  # float
    assert damiao.refresh_request(2).hex() == "0200cc0000000000"
    answer = bytes.fromhex("0200331500004841")
    assert is_register_reply(answer)
    assert damiao.register_answer(answer, 2) == (0x33, 21, 12.5)
    assert damiao.register_answer(answer, 3) is None


def test_no_request_of_ours_stores_to_flash():
    requests = [damiao.read_request(1, 7), damiao.write_request(1, 9, 2000), damiao.refresh_request(1)]
    assert all(request[2] != 0xAA for request in requests)
    assert not hasattr(robstride, "save_frame")


# ---- CubeMars

AK80_9 = grid_of(Ranges(12.5, 50.0, 18.0))


def test_cubemars_reply_by_hand_and_by_the_stock_client():
    """Id 5, q 8000h, dq C00h, tau 400h, 36 °C, error 3."""
    data = bytes.fromhex("05" + "8000" + "c00" + "400" + "24" + "03")
    reply = cubemars.unpack_reply(data, AK80_9)
    assert (reply.drive, reply.temperature, reply.error) == (5, 36, 3)
    assert reply.feedback == pytest.approx((0.00019, 25.0183, -8.9978), abs=1e-4)
    assert cubemars.error_text(reply.error) == "overvoltage (error 3)"
    theirs = CAN_Manager.parse_MIT_message(SimpleNamespace(debug=False), data, "AK80-9")
    assert tuple(theirs)[:3] == pytest.approx(tuple(reply.feedback))
    assert (theirs.temperature, theirs.error) == (36, 3)
    assert cubemars.pack_reply(reply, AK80_9) == data
    short = cubemars.unpack_reply(data[:6], AK80_9)  # as firmware 1.0 has it
    assert (short.feedback, short.temperature, short.error) == (reply.feedback, None, None)
    assert cubemars.pack_reply(short, AK80_9) == data[:6]
    assert cubemars.unpack_reply(data[:7], AK80_9) is None


def test_ranges_of_the_models_are_those_of_the_stock_client_or_of_the_newer_manual():
    newer = {"AK60-6": (12.5, 45.0, 15.0)}  # 50 rad/s in the client
    for model, ranges in cubemars.MODELS.items():
        theirs = MIT_Params.get(model)
        if theirs is not None:
            assert ranges == newer.get(model, (theirs["P_max"], theirs["V_max"], theirs["T_max"]))


@given(st.tuples(st.floats(-12.4, 12.4), st.floats(-49, 49), st.floats(0, 499), st.floats(0, 4.99), st.floats(-17, 17)))
def test_cubemars_commands_beside_the_stock_client(values):
    """It divides by 2^bits instead of 2^bits − 1 and truncates: at most two steps apart, in every field."""
    q, dq, kp, kd, torque = values
    sent = []
    client = SimpleNamespace(debug=False, send_MIT_message=lambda drive, data: sent.append((drive, bytes(data))))
    CAN_Manager.MIT_controller(client, 5, "AK80-9", q, dq, kp, kd, torque)
    ours = pack_command(MitCommand(*values), AK80_9)
    assert sent[0][0] == 5
    for shift, bits in ((48, 16), (36, 12), (24, 12), (12, 12), (0, 12)):
        pair = [int.from_bytes(data, "big") >> shift & (1 << bits) - 1 for data in (ours, sent[0][1])]
        assert abs(pair[0] - pair[1]) <= 2


# ---- RobStride


def test_robstride_motion_command_by_hand():
    """Type 1 to motor 7Fh: torque 8.5 of ±17 is C000h (rounded), q, dq, kp and kd big endian."""
    can_id, data = robstride.motion_frame(0x7F, *robstride.GRIDS["RS01"].steps(MitCommand(12.57, 0.0, 500.0, 0.0, 8.5)))
    assert (can_id, data.hex()) == (0x01BFFF7F, "ffff8000ffff0000")
    back = robstride.unpack_motion(can_id, data, robstride.GRIDS["RS01"])
    assert back == pytest.approx((12.57, 0.0, 500.0, 0.0, 8.5), abs=1e-3)


def test_robstride_frames_by_hand():
    assert robstride.enable_frame(0x7F, 0xFD) == (0x0300FD7F, bytes(8))
    assert robstride.stop_frame(0x7F, 0xFD, clear_fault=True) == (0x0400FD7F, bytes([1, 0, 0, 0, 0, 0, 0, 0]))
    assert robstride.read_frame(1, 0xFD, 0x7019)[1].hex() == "1970000000000000"
    assert robstride.write_frame(1, 0xFD, 0x7028, 2000)[1].hex() == "28700000d0070000"
    assert robstride.write_frame(1, 0xFD, 0x700B, 12.0)[1].hex() == "0b70000000004041"
    assert robstride.parameter_answer(0x110001FD, bytes.fromhex("0b70000000004041")) == (1, 0x700B, 12.0)
    assert robstride.parameter_answer(0x110101FD, bytes.fromhex("0b70000000000000")) == (1, 0x700B, None)


def test_robstride_feedback_beside_the_stock_client():
    """Motor 7Fh in run mode with undervoltage and encoder faults, to host FDh; the client has ±4π for ±12.57."""
    can_id, data = 0x02 << 24 | 2 << 22 | 0b001001 << 16 | 0x7F << 8 | 0xFD, bytes.fromhex("c00060003fff014a")
    found = robstride.unpack_feedback(can_id, data, robstride.GRIDS["RS01"])
    message = can.Message(arbitration_id=can_id, data=data, is_extended_id=True)
    theirs = Client(None, host_can_id=0xFD)._parse_feedback_resp(message, 0x7F, 1)
    assert (found.drive, found.mode, found.temperature) == (0x7F, 2, 33.0)
    assert robstride.fault_names(found.faults) == "undervoltage, encoder"
    assert found.motion == pytest.approx((theirs.angle, theirs.velocity, theirs.torque), abs=3e-3)
    assert [error.value for error in theirs.errors] == [1, 8]
    assert robstride.pack_feedback(found, 0xFD, robstride.GRIDS["RS01"]) == (can_id, data)


def test_ranges_of_the_models_that_other_tables_have_wrong():
    assert robstride.RANGES["RS03"][3:] == (5000.0, 100.0)
    assert robstride.RANGES["RS04"].velocity == 15.0
    assert robstride.RANGES["RS06"].position == 12.57


# ---- moteus


def test_moteus_command_by_hand_and_by_mjbots():
    """The example of the protocol's page: mode 10, position 0.5 rev as floats; query of mode to torque."""
    data = moteus.pack({0x000: 10, 0x020: 0.5, 0x021: 0.0}, (0x000, 0x001, 0x002, 0x003))
    assert data.hex() == "01000a" + "0e20" + "0000003f" + "00000000" + "1100" + "1f01" + "50" * 3
    theirs = protocol.parse_registers(data)
    assert theirs.command == {0x000: 10, 0x020: 0.5, 0x021: 0.0}
    assert theirs.query == [(0, 0), (1, 3), (2, 3), (3, 3)]


def test_moteus_identifiers():
    assert moteus.identifier(0, 1, True) == 0x8001
    assert moteus.identifier(1, 0) == 0x0100


@given(
    st.dictionaries(st.sampled_from([0x001, 0x002, 0x003, 0x00D, 0x00E]), st.floats(-100, 100, width=32)),
    st.sampled_from([moteus.INT16, moteus.INT32, moteus.FLOAT]),
)
def test_moteus_replies_are_what_mjbots_reads(values, resolution):
    data = moteus.pack_subframes([moteus.Subframe(moteus.REPLY, r, v, resolution) for r, v in sorted(values.items())])
    theirs = protocol.parse_reply(data)
    assert theirs.keys() == values.keys()
    for register, value in values.items():
        scale = 0.0 if resolution == moteus.FLOAT else moteus.SCALES[register][resolution]
        most = math.inf if resolution == moteus.FLOAT else scale * (-moteus.NOT_A_NUMBER[resolution] - 1)
        assert theirs[register] == pytest.approx(max(-most, min(most, value)), abs=scale + 1e-9)
    ours = {each.register: each.value for each in moteus.unpack(data)}
    assert ours == pytest.approx(theirs)


@given(st.binary(max_size=64))
def test_any_bytes_are_read_as_mjbots_reads_them(data):
    found = list(moteus.unpack(data))
    theirs = []
    try:
        for each in islice(multiplex.parse_frame(data), len(found)):  # a read may name millions
            if not isinstance(each, multiplex.RegisterSubframe):
                break
            theirs.append(each)
    except (RuntimeError, struct.error, ValueError):  # theirs stops there with an exception
        pass
    for ours, other in zip(found, theirs, strict=False):
        assert ours.register == other.register


def test_nan_in_integers():
    data = moteus.pack_subframes([moteus.Subframe(moteus.REPLY, 0x001, math.nan, moteus.INT16)])
    assert data[2:4].hex() == "0080"
    assert math.isnan(next(moteus.unpack(data)).value)


# ---- ODrive


def from_file(name, data):
    return get_dbc().get_message_by_name(f"Axis3_{name}").decode(data)


def bits(value):
    return struct.unpack("<I", struct.pack("<f", value))[0]


def plain(value):
    return float(value) if isinstance(value, float) else struct.unpack("<f", struct.pack("<I", value))[0]


def test_odrive_messages_by_the_published_file():
    """Every message that we send is what the file says, at the identifier that it says."""
    Message = odrive.Message
    file = get_dbc()
    for message, name in (
        (Message.HEARTBEAT, "Heartbeat"),
        (Message.AXIS_STATE, "Set_Axis_State"),
        (Message.ESTIMATES, "Get_Encoder_Estimates"),
        (Message.CONTROLLER_MODE, "Set_Controller_Mode"),
        (Message.INPUT_POSITION, "Set_Input_Pos"),
        (Message.INPUT_TORQUE, "Set_Input_Torque"),
        (Message.LIMITS, "Set_Limits"),
        (Message.CLEAR_ERRORS, "Clear_Errors"),
        (Message.TORQUES, "Get_Torques"),
    ):
        assert odrive.identifier(3, message) == file.get_message_by_name(f"Axis3_{name}").frame_id
    assert from_file("Set_Axis_State", odrive.pack(Message.AXIS_STATE, 8)) == {
        "Axis_Requested_State": "CLOSED_LOOP_CONTROL"
    }
    modes = from_file("Set_Controller_Mode", odrive.pack(Message.CONTROLLER_MODE, 1, 1))
    assert modes == {"Control_Mode": "TORQUE_CONTROL", "Input_Mode": "PASSTHROUGH"}
    position = from_file("Set_Input_Pos", odrive.input_position(1.5, -0.25, 0.125))
    assert plain(position["Input_Pos"]) == 1.5
    assert (position["Vel_FF"], position["Torque_FF"]) == pytest.approx((-0.25, 0.125))
    torque = from_file("Set_Input_Torque", odrive.pack(Message.INPUT_TORQUE, -0.5))
    assert plain(torque["Input_Torque"]) == -0.5


def test_odrive_readings_by_the_published_file():
    message = get_dbc().get_message_by_name("Axis3_Heartbeat")
    data = message.encode({"Axis_Error": 1 << 24, "Axis_State": 1, "Procedure_Result": 0, "Trajectory_Done_Flag": 1})
    beat = odrive.heartbeat(data)
    assert (beat.error, beat.state, beat.done) == (1 << 24, 1, 1)
    assert odrive.error_names(beat.error) == "watchdog"
    assert isinstance(message, cantools.database.Message)
    data = struct.pack("<ff", 0.25, -1.5)
    assert odrive.unpack(odrive.Message.ESTIMATES, data) == (0.25, -1.5)
    assert odrive.unpack(odrive.Message.ESTIMATES, data[:7]) is None
    assert odrive.unpack(0x1E, data) is None


def test_feedback_is_a_tuple_of_si_values():
    assert unpack_feedback(bytes(5), DM4340) == MitFeedback(-12.5, -10.0, -28.0)


def test_the_cycles_payload_is_what_the_general_way_packs():
    from armlink.drives.moteus.drives import COMMAND, CYCLE_COMMAND, CYCLE_REPLY, QUERY

    values = {register: float(place) for place, register in enumerate(COMMAND)} | {0: 10}
    data = CYCLE_COMMAND.pack(values)
    assert data == moteus.pack(values, QUERY)
    assert CYCLE_COMMAND.unpack(data) == values
    assert CYCLE_COMMAND.unpack(data[:-1] + b"\1") is None
    assert CYCLE_REPLY.unpack(data) is None
    reply = moteus.pack_subframes(
        [moteus.Subframe(moteus.REPLY, r, 1.0, moteus.INT8 if r in moteus.SMALL else moteus.FLOAT) for r in QUERY]
    )
    assert CYCLE_REPLY.unpack(reply) == dict.fromkeys(sorted(QUERY), 1.0)
