"""Joints that a program tells of: ROS 2 joint states, a LeRobot robot. They are only heard; nothing can order them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NoReturn

from pydantic import model_validator

from armlink.arm_file import ArmFile, LinkJoint, Positive
from armlink.bus.listening.joint_messages import CYCLE_ID, JOINT_STATE_FAMILY, READING, READING_ID, TARGET, TARGET_ID
from armlink.drives.base import Ask, BasicDrives, DriveMemory, no_order
from armlink.drives.family import Family
from armlink.drives.orders import DriveIdentity, Limits, Order, Reading, Setup
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits
from armlink.errors import BadInput
from armlink.torque_calibration import Calibration

TRAITS = Traits(
    torque="current", calibration="host", silence="keeps on", bounds=(), cadence="cyclic", frame="11", heard=True
)
"""Of a joint whose effort comes from the motor; `frame` says nothing, since there are no CAN frames."""


class JointStateSettings(DriveSettings):
    """A joint that a program tells of."""

    family: Literal["joint_state"] = "joint_state"
    joint: str
    """Name of the joint in the messages."""
    effort: Literal["torque", "motor", "current"] = "motor"
    """Effort in the messages: torque of a sensor at the joint [N·m], motor torque [N·m], or motor current [A]."""
    torque_constant: Positive | None = None
    """Torque per current [N·m/A] at the drive's output, for `effort: current`."""

    @model_validator(mode="after")
    def _constant_belongs_to_current(self) -> "JointStateSettings":
        if (self.effort == "current") != (self.torque_constant is not None):
            raise ValueError(
                f"effort is {self.effort} and torque_constant is {self.torque_constant}: give torque_constant [N·m/A] "
                "if, and only if, the effort is a current"
            )
        return self

    @property
    def address(self) -> str:
        return f"joint {self.joint}"


class JointStateDrives(BasicDrives[DriveMemory]):
    def __init__(self, arm: ArmFile, joints: Sequence[LinkJoint]) -> None:
        super().__init__(joints, TRAITS)
        self._traits = [
            replace(traits, torque="link" if settings.effort == "torque" else "current")
            for traits, settings in zip(self._traits, self.settings, strict=True)
        ]
        names = [row.name for row in arm.require_link().joints]
        places = [names.index(row.name) for row in joints]
        self._readings = {READING_ID + place: joint for joint, place in enumerate(places)}
        self._targets = {TARGET_ID + place: joint for joint, place in enumerate(places)}

    def routes(self) -> Mapping[int, int]:
        return self._readings

    def commands(self) -> Mapping[int, str]:
        return dict.fromkeys(self._targets, "target of a joint")

    def cycle_ids(self) -> frozenset[int]:
        return frozenset((CYCLE_ID,))

    def cycle_bits(self) -> float:
        """Messages take no time of a wire that is known here."""
        return 0.0

    def take(self, can_id: int, data: bytes, now: float) -> Reading | None:
        if len(data) != READING.size:
            return None
        joint = self._readings[can_id]
        position, velocity, effort = READING.unpack(data)
        settings = self.settings[joint]
        if settings.effort == "torque":
            return self.note(Reading(joint, position, velocity, sensor_torque=effort))
        return self.note(Reading(joint, position, velocity, motor_torque=(settings.torque_constant or 1.0) * effort))

    def command_of(self, can_id: int, data: bytes) -> tuple[int, Order] | None:
        joint = self._targets.get(can_id)
        if joint is None or len(data) != TARGET.size:
            return None
        return joint, no_order()._replace(position=TARGET.unpack(data)[0])

    def details(self, joint: int, sends: bool) -> Mapping[str, Any]:
        return {"id": self.settings[joint].joint}

    def identity(self, joint: int, ask: Ask) -> DriveIdentity:
        self._only_heard(joint)

    def prepare(self, ask: Ask, joint: int, limits: Limits) -> Setup:
        self._only_heard(joint)

    def read_calibration(self, joint: int, ask: Ask) -> Calibration:
        self._only_heard(joint)

    def write_calibration(self, joint: int, ask: Ask, calibration: Calibration, store: bool = False) -> Calibration:
        self._only_heard(joint)

    def _only_heard(self, joint: int) -> NoReturn:
        raise BadInput(
            f"{self.names[joint]}: armlink only listens to this joint (`family: {JOINT_STATE_FAMILY}`), so its drive "
            "cannot be asked, set or moved"
        )


FAMILY = Family(
    name=JOINT_STATE_FAMILY,
    traits=TRAITS,
    settings=JointStateSettings,
    build=JointStateDrives,
    summary="joints whose readings come from ROS 2 or LeRobot; armlink only listens",
)
