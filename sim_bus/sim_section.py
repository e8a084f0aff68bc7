"""The arm file's `sim` section: true parameters of the simulated arm, which no fit may read."""

from typing import Annotated, Any, Literal
from zlib import crc32

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from armlink.arm_file import ArmFile, LinkJoint, Positive, Section
from armlink.errors import BadInput
from armlink.key_errors import describe
from sim_bus.effects.quasi_direct import QuasiDirect
from sim_bus.effects.registry import check_entry

Vector3 = Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]
DEFAULT_BITS = 16
NOISE_SHARE = 0.002
"""Default standard deviation of the torque sensors' noise, as a share of rated torque."""


class LinkBody(Section):
    """One link as a rigid body, in the frame that turns with its joint, origin on the joint's axis (bar frame)."""

    mass: Positive
    """[kg]."""
    com: Vector3
    """Centre of mass in the bar frame [m]."""
    inertia: Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=6)]
    """About the centre of mass, axes parallel to the bar frame [kg·m²]: xx, yy, zz or xx, yy, zz, xy, xz, yz."""

    @model_validator(mode="after")
    def _inertia_has_three_or_six(self) -> "LinkBody":
        if len(self.inertia) not in (3, 6):
            raise ValueError("inertia: give 3 values (xx, yy, zz) or 6 (xx, yy, zz, xy, xz, yz) [kg·m²]")
        if min(self.inertia[:3]) <= 0:
            raise ValueError(f"inertia: xx, yy and zz must be positive, not {list(self.inertia[:3])} [kg·m²]")
        return self


class Sensors(Section):
    """Sensors, one value per joint: torque `v = gain·τ + offset`, position `θ = position_gain·φ + position_offset`."""

    gain: tuple[FiniteFloat, ...] | None = None
    """Default 1."""
    offset: tuple[FiniteFloat, ...] | None = None
    """[N·m], default 0."""
    position_gain: tuple[FiniteFloat, ...] | None = None
    """Default 1."""
    position_offset: tuple[FiniteFloat, ...] | None = None
    """[rad], default 0."""
    noise: tuple[Annotated[FiniteFloat, Field(ge=0)], ...] | None = None
    """Standard deviation of the torque reading's noise [N·m], default 0.2 % of rated torque."""
    bits: Annotated[int, Field(ge=8, le=24)] | tuple[Annotated[int, Field(ge=8, le=24)], ...] = DEFAULT_BITS
    """Resolution of the torque sensor over ±2 rated torques, and of the position sensor over a revolution [bit]."""


class Servo(Section):
    """Position loop and ramps of the drives."""

    bandwidth: Positive = 40.0
    """Natural frequency of the position loop with the arm's own inertia [rad/s]."""
    damping: Positive = 1.0
    """Damping ratio of the position loop."""
    deadband: Positive = 2e-4
    """Dead band of the integrator, against hunting under stiction [rad]."""
    quick_stop_deceleration: Positive = 5.0
    """[rad/s²]."""
    brake: bool = True
    """Whether a holding brake closes while the drive is not enabled."""


class Stops(Section):
    time_constant: Positive = 0.004
    """Time constant of the contact's critically damped spring and damper [s]."""


class EffectEntry(BaseModel):
    """One imperfection: `effect` (an id of the catalogue), `joint` (or link) and its parameters by name."""

    model_config = ConfigDict(extra="allow", frozen=True)

    effect: str
    joint: str | None = None

    @model_validator(mode="after")
    def _known(self) -> "EffectEntry":
        check_entry(self.effect, self.joint, self.parameters)
        return self

    @property
    def parameters(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Realism(Section):
    """All small troubles of a real arm at once, drawn at published levels (`sim_bus.effects.realism`)."""

    level: Annotated[FiniteFloat, Field(ge=0, le=10)] = 1.0
    """0 none, 1 what good arms have after calibration, 3 what bad ones have."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Draws another arm."""


class SimSection(Section):
    """The `sim` section. `links` may be absent if `kinematics.model` (URDF or MJCF) has the inertial parameters."""

    links: tuple[LinkBody, ...] | None = None
    sensors: Sensors = Sensors()
    effects: tuple[EffectEntry, ...] = ()
    device: Literal["ours", "cia402", "epos4", "nanotec", "copley", "sample", "profile", "velocity"] | None = None
    """Which CiA 402 devices the joints have; default: ours, or a stock one if the arm file reads torque elsewhere."""
    realism: Realism = Realism(level=0.0)
    """Small troubles of a real arm, on top of `effects`."""
    quasi_direct: QuasiDirect | None = None
    """Torque constants, zeros, friction and warming of quasi-direct drives, drawn; on top of `effects`."""
    servo: Servo = Servo()
    stops: Stops = Stops()
    step: Annotated[FiniteFloat, Field(gt=0, le=0.005)] = 0.001
    """Maximum time step of the physics [s]; the SYNC period is a whole number of steps."""
    start: tuple[FiniteFloat, ...] | None = None
    """Joint angles at power-on [rad]; default: middle of each joint's range."""


def with_realism(arm: ArmFile, level: float, seed: int = 0) -> ArmFile:
    """The arm with the small troubles of a real one. Raises BadInput."""
    try:
        realism = Realism(level=level, seed=seed)
    except ValidationError as error:
        raise BadInput(f"realism {level:g}: {describe(error)}") from None
    return arm.model_copy(update={"sim": sim_section(arm).model_copy(update={"realism": realism})})


def sim_section(arm: ArmFile) -> SimSection:
    """The arm's `sim` section, lists checked against the number of joints. Raises BadInput."""
    section = arm.require(SimSection, "sim")
    count = len(arm.joint_names)
    lists: dict[str, Any] = {"links": section.links, "start": section.start}
    lists |= {f"sensors.{key}": getattr(section.sensors, key) for key in Sensors.model_fields}
    for key, values in lists.items():
        if isinstance(values, tuple) and len(values) != count:
            raise BadInput(f"{arm.path}: key sim.{key} has {len(values)} values, expected {count}, one for each joint")
    if section.links is None and arm.kinematics.model is None:
        raise BadInput(f"{arm.path}: key sim.links is missing: give mass, com and inertia of each link")
    for number, entry in enumerate(section.effects):
        if entry.joint is not None and entry.joint not in arm.joint_names:
            raise BadInput(
                f"{arm.path}: key sim.effects.{number}.joint: there is no joint {entry.joint!r}; expected one of "
                f"{', '.join(arm.joint_names)}"
            )
    return section


def serial_of(arm: ArmFile, joint: LinkJoint) -> int:
    """Serial number of a joint's drive: its own on every arm."""
    return crc32(f"{arm.name} {arm.serial} {joint.name}".encode())
