"""Reading a parameter of a RobStride drive among the frames of others."""

import struct
from types import SimpleNamespace

from armlink.bus.port import EXTENDED
from armlink.drives.robstride.drives import RobStrideDrives, RobStrideSettings
from armlink.drives.robstride.frames import Type, identifier

SETTINGS = RobStrideSettings(id=5, model="RS02", kp=20.0, kd=1.0)


def answer(drive: int, parameter: int, value: float, kind: int = Type.READ) -> tuple[int, bytes]:
    return identifier(kind, drive, SETTINGS.host) | EXTENDED, struct.pack("<H2xf", parameter, value)


def test_the_answer_is_that_of_the_drive_to_the_parameter():
    drives = RobStrideDrives(None, [SimpleNamespace(name="elbow", settings=SETTINGS)])
    frames = [
        answer(5, 0x7019, 9.0, Type.FEEDBACK),
        answer(6, 0x7019, 1.0),
        answer(5, 0x7018, 2.0),
        (0x123, bytes(8)),
        answer(5, 0x7019, 3.0),
        answer(5, 0x7019, 4.0),
    ]

    def ask(frame, match):
        return next((found for each in frames if (found := match(*each)) is not None), None)

    assert drives.read_parameter(ask, 0, 0x7019) == 3.0
    del frames[-2:]
    assert drives.read_parameter(ask, 0, 0x7019) is None
