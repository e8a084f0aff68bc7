"""Records of a two-joint arm, made by hand."""

import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import sqlalchemy as sa

from armlink.arm_file import ArmFile, parse_arm
from armlink.link.types import Calibration
from calib.install.journaled_write import Controllers
from calib.records.records import CalibrationRecord, GravityRecord, JointCalibration, matrix, provenance
from calib.records.store import RecordStore

WHEN = datetime(2026, 11, 21, 2, 0, tzinfo=UTC)


def arm_file(**changes: object) -> ArmFile:
    joints = [{"name": name, "a": 0.3, "lower": -1.0, "upper": 1.0} for name in ("shoulder", "elbow")]
    return parse_arm({"name": "bench", "serial": "7", "kinematics": {"joints": joints}} | changes, Path("bench.yaml"))


ARM = arm_file()


def put_on(controllers: Controllers, record: CalibrationRecord) -> None:
    """A record on the controllers, as if it had been there before the test: no gate, no journal."""
    for j, joint in enumerate(record.joints):
        wanted = joint.torque_calibration(controllers.read_calibration(j))
        controllers.write_calibration(j, Calibration(wanted.gain, wanted.offset, record.number))


def calibration(gain: float = 1.02, parent: str | None = None) -> CalibrationRecord:
    shoulder = JointCalibration(name="shoulder", gain=gain, offset=0.1, position_gain=1.0, position_offset=1e-5)
    elbow = JointCalibration(
        name="elbow",
        gain=None,
        offset=-0.2,
        position_gain=1.001,
        position_offset=0.0,
        not_identifiable={"gain": "no gravity torque"},
    )
    return CalibrationRecord(
        **provenance(ARM, {"sweep": "ab" * 32}, WHEN),
        joints=(shoulder, elbow),
        covariance_of=("shoulder.gain", "elbow.offset"),
        covariance=matrix(np.diag([1e-6, 4e-6])),
        parent=parent,
    )


def gravity() -> GravityRecord:
    return GravityRecord(
        **provenance(ARM, created=WHEN),
        names=("shoulder", "elbow"),
        beta=(1.0, 0.5, 0.0, 0.25),
        covariance=matrix(np.eye(4) * 1e-6),
        identifiable=(True, True, False, True),
        gravity=(0.0, 0.0, -9.80665),
    )


def activate_by_hand(store: RecordStore, record: CalibrationRecord | GravityRecord) -> None:
    """A record made current as an armlink without bounds did."""
    store.add(record)
    with sa.create_engine(store.url).begin() as connection:
        connection.execute(
            sa.text(
                'INSERT INTO activations (record, kind, arm, serial, at, "by", reason)'
                " VALUES (:record, :kind, :arm, :serial, '2026-11-28T00:00:00+00:00', 'ann', '')"
            ),
            {"record": record.id, "kind": record.kind, "arm": record.arm, "serial": record.serial},
        )


def copied(path: Path, to: Path) -> Path:
    """A copy of a store, as a backup makes it."""
    with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(to)) as target:
        source.backup(target)
    return to
