"""Keys of a CubeMars joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from armlink.arm_file import Positive
from armlink.drives.cubemars.frames import MODELS
from armlink.drives.mit_packing import Ranges
from armlink.drives.settings import DriveSettings


class CubeMarsSettings(DriveSettings):
    """A CubeMars AK drive in MIT mode."""

    family: Literal["cubemars"] = "cubemars"
    id: Annotated[int, Field(ge=1, le=0x7F)]
    """CAN id: that of its commands."""
    reply: Annotated[int, Field(ge=0, le=0x7F)] = 0
    """Master id: that of its replies, which tell its own id in their first byte."""
    model: str = ""
    """Model as on its label, for example AK80-9: its ranges, where the keys below do not give them."""
    position_range: Positive | None = None
    """End of the packed positions [rad]; None: the model's."""
    velocity_range: Positive | None = None
    """[rad/s]."""
    torque_range: Positive | None = None
    """[N·m]."""
    can_timeout: Annotated[int, Field(ge=0, le=100_000)] = 0
    """CAN timeout as set in the drive over its serial port [cycles of its own loop]; 0: none, the drive keeps on."""
    kp: Annotated[FiniteFloat, Field(ge=0, le=500)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0, le=5)]
    """Damping under position control [N·m·s/rad]."""

    @model_validator(mode="after")
    def _ranges_are_known(self) -> "CubeMarsSettings":
        given = (self.position_range, self.velocity_range, self.torque_range)
        if self.model.upper() not in MODELS and None in given:
            raise ValueError(
                f"model {self.model!r} is unknown: give one of {', '.join(MODELS)}, or give position_range, "
                "velocity_range and torque_range from the manual"
            )
        return self

    @model_validator(mode="after")
    def _replies_differ_from_commands(self) -> "CubeMarsSettings":
        if self.reply == self.id:
            raise ValueError(
                f"reply {self.reply:#04x} is the id of the drive itself, so replies would look like commands "
                "of another host: set another master id in the drive (set_master_id, over its serial port)"
            )
        return self

    @property
    def ranges(self) -> Ranges:
        """By which its frames are coded."""
        of_model = MODELS.get(self.model.upper(), (0.0, 0.0, 0.0))
        given = (self.position_range, self.velocity_range, self.torque_range)
        return Ranges(*(own or usual for own, usual in zip(given, of_model, strict=True)))

    @property
    def address(self) -> str:
        return f"id {self.id:02X}h"
