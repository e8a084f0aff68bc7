"""Raw frame logs: replayed they give the samples that were recorded live; cut anywhere they load up to the cut."""

import gzip
import json
import struct
from datetime import datetime

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armlink.arm_file import load_arm
from armlink.bus.frame_log import FrameLog, LogReader, is_log
from armlink.bus.in_process import InProcessBus
from armlink.bus.taps import TappedBus
from armlink.cli import run
from armlink.errors import BadInput
from armlink.recording.files import load_recording
from armlink.recording.recorder import Recorder
from armlink.recording.replay import frames_of_log, frames_of_recording, play_onto, recording_of_log

SUFFIXES = (".asc", ".blf", ".log")
EPOCH = 1_790_000_000.123456


class Conversation:
    """A bus on which two joints (nodes 1, 2) and their host talk, with error frames and others' in between."""

    channel_info = "conversation"

    def __init__(self, cycles, seed=0):
        rng = np.random.default_rng(seed)
        self.time, self.messages = 0.0, []
        for cycle in range(cycles):
            t = EPOCH + cycle * 0.004 + rng.uniform(0, 0.0004)
            self.add(t, 0x201, struct.pack("<Hhi", 15, cycle, -cycle))
            self.add(t + 1e-4, 0x80, b"")
            for node in (1, 2):
                self.add(t + 5e-4, 0x180 + node, rng.bytes(8))
            self.messages.append(can.Message(timestamp=t + 6e-4, is_error_frame=True))
            self.messages.append(can.Message(timestamp=t + 7e-4, arbitration_id=0x18FF0001, data=b"\x01"))
            if cycle % 4 == 0:
                self.add(t + 8e-4, 0x281, struct.pack("<Hhi", 0x27, 3, 4))
        self.clock = self

    def add(self, t, can_id, data):
        self.messages.append(can.Message(timestamp=t, arbitration_id=can_id, data=data, is_extended_id=False))

    def now(self):
        return self.time

    def recv(self, timeout):
        self.time += timeout if not self.messages else 0.0
        return self.messages.pop(0) if self.messages else None

    def shutdown(self):
        pass


def record(arm, path, cycles=60):
    with FrameLog(path) as log:
        return list(Recorder(arm, TappedBus(Conversation(cycles), log.write)).rows(1.0))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_replayed_log_gives_the_samples_recorded_live_bit_for_bit(arm_of, tmp_path, suffix):
    live = record(arm_of(2), tmp_path / f"run{suffix}")
    again = recording_of_log(arm_of(2), tmp_path / f"run{suffix}")
    assert len(live) == 59
    assert again.warning == ""
    assert again.t.tobytes() == np.array([t for t, _ in live]).tobytes()
    for name, values in again.channels().items():
        assert values.tobytes() == np.array([row[name] for _, row in live]).tobytes(), name


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_message_is_in_the_log(arm_of, tmp_path, suffix):
    record(arm_of(2), tmp_path / f"run{suffix}")
    written = list(can.LogReader(str(tmp_path / f"run{suffix}")))
    sent = Conversation(60).messages
    assert [bytes(m.data) for m in written if not m.is_error_frame] == [
        bytes(m.data) for m in sent if not m.is_error_frame
    ]


@pytest.fixture(scope="module", params=SUFFIXES)
def whole(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / f"run{request.param}"
    with FrameLog(path) as log:
        bus = TappedBus(Conversation(250), log.write)
        while bus.take(0.0):
            pass
    return path, path.read_bytes(), list(LogReader(path).frames())


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_log_cut_at_any_byte_loads_up_to_the_cut_and_says_so(whole, data):
    path, content, frames = whole
    cut = data.draw(st.integers(0, len(content) - 1))
    shorter = path.with_name(f"cut{path.suffix}")
    shorter.write_bytes(content[:cut])
    reader = LogReader(shorter)
    loaded = list(reader.frames())
    assert loaded == frames[: len(loaded)]
    between_lines = path.suffix == ".log" and content[:cut][-1:] in (b"\n", b"")  # candump's log has no end
    assert reader.warning or between_lines
    lost = cut / len(content) * len(frames) - len(loaded)
    assert lost < (300 if path.suffix == ".blf" else 20)  # a BLF container holds some 200 frames


def test_content_that_is_none_is_said_in_one_line(arm_of, tmp_path):
    for suffix in SUFFIXES:
        (tmp_path / f"a{suffix}").write_bytes(b"(1.0) can0 zz#\xff\xff\n1 2 3\n" * 3)
        with pytest.raises(BadInput, match="0 whole cycles"):
            recording_of_log(arm_of(2), tmp_path / f"a{suffix}")
    with pytest.raises(BadInput, match="no frame log"):
        LogReader(tmp_path / "none.log")
    with pytest.raises(BadInput, match=r"expected \.asc, \.blf, \.log"):
        FrameLog(tmp_path / "a.txt")


def test_only_what_joints_send_is_played_onto_a_bus_and_only_a_virtual_one(arm_of, tmp_path):
    record(arm_of(2), tmp_path / "run.log")
    assert {can_id for _, can_id, _ in frames_of_log(arm_of(2), tmp_path / "run.log")} == {0x80, 0x181, 0x182, 0x281}
    recording = recording_of_log(arm_of(2), tmp_path / "run.log")
    with pytest.raises(BadInput, match="only on a virtual bus"):
        play_onto(arm_of(2), tmp_path / "run.log", recording, "socketcan:can0", 0.0)
    with can.Bus(interface="virtual", channel="replayed") as listener:
        count = play_onto(arm_of(2), tmp_path / "run.log", recording, "virtual:replayed", 0.0)
        heard = [listener.recv(0) for _ in range(count)]
    assert [bytes(m.data) for m in heard] == [data for _, _, data in frames_of_log(arm_of(2), tmp_path / "run.log")]


def test_a_recording_goes_onto_a_bus_as_the_frames_that_joints_would_have_sent(arm_of, tmp_path):
    class Played(InProcessBus):
        channel_info, time = "played", 0.0

        def __init__(self, frames):
            self.frames, self.clock, self.ended = list(frames), self, False

        def now(self):
            return self.time

        stamp = now

        def shutdown(self):
            pass

        def take(self, timeout=0.0):
            self.time, can_id, data = self.frames.pop(0)
            self.ended = not self.frames
            return can_id, data

        def put(self, can_id, data):
            raise AssertionError("a recorder sends nothing")

    record(arm_of(2), tmp_path / "run.log")
    recording = recording_of_log(arm_of(2), tmp_path / "run.log")
    rows = list(Recorder(arm_of(2), Played(frames_of_recording(arm_of(2), recording))).rows(10.0))
    for name in ("position", "torque", "motor_torque"):
        again = np.array([row[name] for _, row in rows])
        np.testing.assert_array_equal(again, getattr(recording, name)[: len(rows)])
    with pytest.raises(BadInput, match="2 joints, but test has 3"):
        list(frames_of_recording(arm_of(3), recording))


def test_the_command_decodes_shows_and_refuses(tmp_path, capsys):
    assert run(["record", "sarcos", "--bus", "armlink_sim:sarcos"]) == 2
    assert "nothing to write" in capsys.readouterr().err
    assert run(["replay", "sarcos", str(tmp_path / "none.blf")]) == 2
    (tmp_path / "a.csv").write_text("t,q_1,tau_1\n0,1,2\n0.5,1.5,3\n")
    assert run(["replay", "sarcos", str(tmp_path / "a.csv"), "--speed", "0", "--json", "-"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["rows"] == 2
    assert "+1.5000" in captured.err
    assert run(["replay", "sarcos", str(tmp_path / "a.csv"), str(tmp_path / "b.mcap")]) == 0
    assert load_recording(tmp_path / "b.mcap").t.size == 2
    assert run(["replay", "sarcos", str(tmp_path / "a.csv"), "--bus", "socketcan:can0"]) == 2


def test_a_time_that_is_infinite_ends_the_log(tmp_path):
    path = tmp_path / "run.log"
    path.write_text("(1.0) can0 080#\n(2.0) can0 081#01\n(1e999) can0 080#\n(3.0) can0 080#\n")
    reader = LogReader(path)
    assert len(list(reader.frames())) == 2
    assert "a time is not a number" in reader.warning


def printed(message: can.Message, time: str) -> str:
    """As can-utils' candump prints a frame."""
    can_id = f"{message.arbitration_id:08X}" if message.is_extended_id else f"{message.arbitration_id:03X}"
    stamp = f" ({time})" if time else ""
    return f"{stamp}  can0  {can_id}   [{message.dlc}]  {message.data.hex(' ').upper()}\n"


@pytest.mark.parametrize("kind", ["candump -ta", "candump -tA", "pcan", "csv", "candump -L, packed", "pcan, packed"])
def test_logs_that_others_write_give_the_same_samples(arm_of, tmp_path, kind):
    arm = arm_of(2)
    record(arm, tmp_path / "run.log")
    with can.CanutilsLogReader(str(tmp_path / "run.log")) as reader:
        messages = [each for each in reader if not each.is_error_frame]
    if kind.startswith("candump -t"):
        path = tmp_path / "other.log"
        dates = "A" in kind
        path.write_text(
            "".join(
                printed(
                    each,
                    str(datetime.fromtimestamp(each.timestamp)).ljust(26, "0") if dates else f"{each.timestamp:.6f}",
                )
                for each in messages
            )
        )
    elif kind == "candump -L, packed":
        path = tmp_path / "run.log.gz"
        path.write_bytes(gzip.compress((tmp_path / "run.log").read_bytes()))
    else:
        path = tmp_path / ("other.csv" if kind == "csv" else "other.trc")
        with (can.CSVWriter if kind == "csv" else can.TRCWriter)(str(path)) as writer:
            for message in messages:
                writer(message)
        if "packed" in kind:
            packed = tmp_path / "other.trc.gz"
            packed.write_bytes(gzip.compress(path.read_bytes()))
            path = packed
    assert is_log(path)
    expected, found = (recording_of_log(arm, each) for each in (tmp_path / "run.log", path))
    for name, values in expected.channels().items():
        np.testing.assert_array_equal(getattr(found, name), values)
    np.testing.assert_allclose(found.t, expected.t, atol=2e-4 if "pcan" in kind else 2e-6)


def test_a_log_without_times_says_so_and_keeps_its_cycles(arm_of, tmp_path):
    arm = arm_of(2)
    record(arm, tmp_path / "run.log")
    with can.CanutilsLogReader(str(tmp_path / "run.log")) as reader:
        (tmp_path / "plain.log").write_text("".join(printed(each, "") for each in reader if not each.is_error_frame))
    expected, found = (recording_of_log(arm, tmp_path / name) for name in ("run.log", "plain.log"))
    assert "no times" in found.warning
    np.testing.assert_array_equal(found.position, expected.position)


@pytest.mark.parametrize("text", ["(1.0) can0 7FF#00\n(1.1) can0 7FF#01\n", "nothing\n"])
def test_what_a_log_lacks_of_the_arm_is_named(arm_of, tmp_path, text):
    (tmp_path / "other.log").write_text(text)
    with pytest.raises(BadInput) as refused:
        recording_of_log(load_arm("six-damiao"), tmp_path / "other.log")
    said = str(refused.value)
    if "7FF" in text:
        assert "no frame comes from base (id 01h), shoulder (id 02h)" in said
        assert "the log has the frames 7FFh" in said
    else:
        assert "no frame could be read" in said
    assert "SYNC" not in said


def test_a_packed_log_that_was_cut_loads_up_to_the_cut_and_says_so(arm_of, tmp_path):
    record(arm_of(2), tmp_path / "run.log", cycles=2000)
    whole = gzip.compress((tmp_path / "run.log").read_bytes())
    (tmp_path / "cut.log.gz").write_bytes(whole[: len(whole) * 2 // 3])
    found = recording_of_log(arm_of(2), tmp_path / "cut.log.gz")
    assert "the file ends early" in found.warning
    assert 500 < found.t.size < 1900


@pytest.mark.parametrize("line", [" " * 60_000, "(1) " + " " * 60_000, "a " * 30_000, "can0 001 [8] " + "00 " * 20_000])
def test_a_long_line_that_is_no_frame_takes_no_time(tmp_path, line):
    (tmp_path / "a.log").write_text(line + "\n")
    LogReader(tmp_path / "a.log")._as_logged(line)  # in quadratic time some minutes
