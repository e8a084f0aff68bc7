"""The `sweep` section of the arm file. Every key has a default, so that the section may be left out."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from armlink.arm_file import ArmFile, Positive, Section
from armlink.drives.family import family
from armlink.errors import BadInput
from gcomp.identify.motor_model import MotorDoubt
from gcomp.identify.parameters import Prior

Motion = Literal["creep", "steps"]
Share = Annotated[FiniteFloat, Field(gt=0, lt=1)]


class CreepSection(Section):
    """How a joint creeps, for arms whose torque is a motor current (docs/no-torque-sensors.md)."""

    speeds: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=4)] = (0.1, 0.2)
    """Speeds of the swept joint, one a pose in turn [rad/s]: slow enough that inertia does not show, fast enough that
    friction is beyond its minimum (Stribeck)."""
    poses: Annotated[int, Field(ge=1, le=8)] = 2
    """Poses of the other joints per swept joint."""
    bin: Positive = 0.08
    """Way over which readings are averaged [rad]: more than two periods of gear and cogging ripple."""
    span: Positive = 2.0
    """Longest way of one creep [rad], its ends included; where a joint has more range, the plan chooses the part."""
    contact_lead: Positive = 0.08
    """A creeping joint that is so far behind its target has touched something [rad]; further for soft position loops,
    until they pull by 1.5 N·m."""
    zero_std: Annotated[FiniteFloat, Field(gt=0)] = 0.03
    """Standard deviation of the position zeros beforehand, which such arms get by hand [rad]."""


Place = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class ParkedArm(Section):
    """An arm that stands beside this one and keeps still; nothing moves before collisions with it are excluded."""

    model: Path | None = None
    """Its URDF or MJCF file, a path from the arm file; none where `kinematics.model` has both arms."""
    at: Place = (0.0, 0.0, 0.0)
    """Origin of its model in the world frame of `kinematics.model` [m]."""
    turned: Place = (0.0, 0.0, 0.0)
    """Rotation of its model about the x, then the y, then the z axis of that frame [rad]."""
    pose: dict[str, FiniteFloat] = Field(default_factory=dict)
    """Angles at which its joints are parked, by name; the others are at their model's zero [rad]."""


class SweepSection(Section):
    """Steps, poses, settle rule, averaging and how resting joints are held."""

    motion: Motion | None = None
    """Creep at constant speed, or steps at rest; by default creep where every drive's torque is a motor current."""
    creep: CreepSection = CreepSection()
    """How joints creep."""
    steps: Annotated[int, Field(ge=5, le=200)] = 6
    """Positions per sweep; each is read on the way up and on the way down."""
    poses: Annotated[int, Field(ge=1, le=8)] = 2
    """Stop combinations of the resting joints per swept joint."""
    loaded_poses: Annotated[int, Field(ge=1, le=8)] = 1
    """Stop combinations in the pass with the reference mass."""
    hold: Literal["stops", "servo"] = "stops"
    """Resting joints are pressed on their stops (only the swept joint's sensor counts) or servo-held (all count)."""
    range_margin: Annotated[FiniteFloat, Field(gt=0)] = 0.06
    """Distance that the steps of a sweep keep from the mechanical stops [rad]."""
    approach_speed: Positive = 0.1
    """Speed at which a joint is brought against its stop [rad/s]."""
    travel_speed: Share = 0.9
    """Speed of travel as a share of each joint's max_velocity."""
    acceleration: Positive = 3.0
    """Peak acceleration of travel and of steps [rad/s²]."""
    bias_torque: tuple[Positive, ...] | None = None
    """Torque that presses each joint against its stop [N·m]; by default from the scout's rough gravity model."""
    bias_margin: Share = 0.05
    """Margin of the bias torque over gravity, friction and model error, as a share of max_torque."""
    friction: Share = 0.06
    """Allowance for friction of the drives, as a share of rated torque."""
    gain_tolerance: Share = 0.15
    """Allowance for the error of the torque scale before calibration."""
    settle_window: Positive = 0.15
    """Window over which velocity and torque scatter are judged [s]; where it is not given and drives have kp and kd,
    three of their slowest time constants."""
    settle_velocity: Positive = 0.001
    """Speed over the window below which a joint is at rest [rad/s]."""
    settle_scatter: Positive = 1.2
    """Torque has settled if its scatter over the window is below this multiple of the sensor's own noise."""
    settle_timeout: Positive = 4.0
    """Time after which a step that has not settled is read all the same, and marked [s]; the average follows it."""
    standard_error: Share = 0.00035
    """Standard error of the torque averages, as a share of rated torque; smaller if `gain_std` requires it."""
    gain_std: Share = 0.001
    """Standard deviation of the torque gains to reach: if the plan predicts more, it averages longer."""
    max_samples: Annotated[int, Field(ge=10)] = 200
    """Largest number of samples in an average."""
    reference_mass: Positive | None = None
    """Mass attached for the second pass [kg]; by default chosen from the torque limits."""
    reference_point: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    """Centre of the mass, if measured: in the frame that turns with the last joint, origin on its axis, z along it and
    x along `a` [m]; by default it is fitted. It determines the gains' common scale if all axes nearly meet."""
    reference_point_std: Positive = 0.001
    """Standard deviation of `reference_point` [m]."""
    position_offset_std: Annotated[FiniteFloat, Field(ge=0)] = 0.005
    """Standard deviation of the position sensors' zero beforehand [rad]; 0 for exact."""
    beside: tuple[ParkedArm, ...] = ()
    """Arms that are parked within reach, such as the other one of a pair."""

    @model_validator(mode="after")
    def _one_bias_a_joint(self) -> "SweepSection":
        if self.bias_torque is not None and not self.bias_torque:
            raise ValueError("bias_torque is empty: give one torque for each joint, or leave bias_torque out")
        return self

    @property
    def known_point(self) -> Prior | None:
        """Prior on the place of the reference mass, None without one."""
        if self.reference_point is None:
            return None
        return Prior(np.array(self.reference_point), self.reference_point_std)

    @property
    def motor_doubt(self) -> MotorDoubt:
        """Of drives whose torque is a motor current, before any sweep."""
        return MotorDoubt(zero=self.creep.zero_std, point=self.known_point)


def sweep_section(arm_file: ArmFile) -> SweepSection:
    """The arm file's `sweep` section, or the defaults without one; raises BadInput on a wrong length."""
    section = arm_file.sweep if isinstance(arm_file.sweep, SweepSection) else SweepSection()
    n = len(arm_file.require_link().joints)
    if section.bias_torque is not None and len(section.bias_torque) != n:
        raise BadInput(
            f"{arm_file.path}: key sweep.bias_torque has {len(section.bias_torque)} values, expected {n}, "
            "one for each joint"
        )
    if section.beside and arm_file.model_path is None:
        raise BadInput(
            f"{arm_file.path}: key sweep.beside: checking for collisions needs geometry: give a URDF or MJCF "
            "as kinematics.model"
        )
    return section


def sweep_motion(arm_file: ArmFile) -> Motion:
    """`sweep.motion` of the arm file; without it creep where the torque of every drive is a motor current.

    At rest friction holds a joint at any torque within its band, and a motor current cannot tell friction from gravity;
    a torque sensor behind the friction can.
    """
    stated = sweep_section(arm_file).motion
    if stated is not None:
        return stated
    joints = arm_file.require_link().joints
    return "creep" if all(family(each.settings.family).traits.torque == "current" for each in joints) else "steps"


def with_hold(arm_file: ArmFile, hold: str | None) -> ArmFile:
    """The arm with its resting joints held on `stops` or by `servo`; None leaves the arm file's. Raises BadInput."""
    if hold is None:
        return arm_file
    if hold not in ("stops", "servo"):
        raise BadInput(f"--hold {hold}: expected stops or servo")
    return arm_file.model_copy(update={"sweep": sweep_section(arm_file).model_copy(update={"hold": hold})})
