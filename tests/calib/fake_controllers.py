"""Two joint controllers in memory, and the record that they hold."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile, parse_arm
from armlink.errors import BusFault
from armlink.link.types import Calibration, DriveSerial
from calib.records.records import CalibrationRecord, JointCalibration, matrix, provenance

NAMES = ("shoulder", "elbow")


def arm_file() -> ArmFile:
    joints = [{"name": name, "a": 0.3, "lower": -1.0, "upper": 1.0} for name in NAMES]
    link = [{"name": name, "node": k + 1, "rated_torque": 50.0, "max_torque": 60.0} for k, name in enumerate(NAMES)]
    content = {"name": "bench", "serial": "7", "kinematics": {"joints": joints}, "link": {"joints": link}}
    return parse_arm(content, Path("bench.yaml"))


ARM = arm_file()


def joint(name: str, gain: float | None = 1.1, offset: float = -0.4) -> JointCalibration:
    reason = {} if gain is not None else {"gain": "no gravity torque"}
    return JointCalibration(
        name=name, gain=gain, offset=offset, position_gain=1.0, position_offset=0.0, not_identifiable=reason
    )


def record(**changes: object) -> CalibrationRecord:
    content: dict[str, object] = {
        "joints": tuple(joint(name) for name in NAMES),
        "covariance_of": tuple(f"{name}.{parameter}" for name in NAMES for parameter in ("gain", "offset")),
        "covariance": matrix(np.diag([1e-6, 1e-4, 1e-6, 1e-4])),
        "confirmed_by": "ann",
    }
    return CalibrationRecord(**provenance(ARM, created=datetime(2026, 11, 21, tzinfo=UTC)), **(content | changes))


def as_real32(given: Calibration) -> Calibration:
    """As a controller keeps it."""
    return replace(given, gain=float(np.float32(given.gain)), offset=float(np.float32(given.offset)))


class Controllers:
    """Two joint controllers; REAL32, as a real one holds it."""

    def __init__(self, gain: float = 1.1, offset: float = -0.4) -> None:
        self.held = [as_real32(Calibration(gain, offset)) for _ in NAMES]
        self.broken = False
        self.drives = ["1:1:a", "1:1:b"]

    def drive_serial(self, joint: int) -> DriveSerial:
        return DriveSerial(self.drives[joint])

    def read_calibration(self, joint: int) -> Calibration:
        return self.held[joint]

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        if self.broken:
            raise BusFault("no answer")
        self.held[joint] = as_real32(calibration)
        return self.held[joint]
