"""Recordings are played onto virtual buses alone."""

from types import SimpleNamespace

import pytest

from armlink.errors import BadInput
from armlink.recording import replay


@pytest.mark.parametrize(
    ("spec", "virtual"),
    [
        ("socketcan:can0", False),
        ("slcan:/dev/ttyACM0", False),
        ("virtual:test", True),
        ("socketcan:vcan0", True),
        ("udp_multicast:239.0.0.1", True),
    ],
)
def test_no_frame_of_a_replay_reaches_a_real_bus(monkeypatch, tmp_path, spec: str, virtual: bool) -> None:
    opened: list[str] = []

    def open_bus(spec: str, section: object) -> SimpleNamespace:
        opened.append(spec)
        return SimpleNamespace(open_port=lambda: None, shutdown=lambda: None)

    monkeypatch.setattr(replay, "open_bus", open_bus)
    monkeypatch.setattr(replay, "is_log", lambda source: False)
    monkeypatch.setattr(replay, "frames_of_recording", lambda arm, recording: [])
    monkeypatch.setattr(replay, "_play", lambda frames, port, clock, speed: 7)
    arm = SimpleNamespace(require_link=lambda: SimpleNamespace(bus=None))
    if virtual:
        assert replay.play_onto(arm, tmp_path, None, spec, 1.0) == 7
    else:
        with pytest.raises(BadInput, match="only on a virtual bus"):
            replay.play_onto(arm, tmp_path, None, spec, 1.0)
    assert opened == [spec] * virtual
