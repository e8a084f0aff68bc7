"""Keys of a RobStride joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from armlink.drives.robstride.frames import RANGES
from armlink.drives.settings import DriveSettings


class RobStrideSettings(DriveSettings):
    """A RobStride drive in the private protocol (29-bit identifiers)."""

    family: Literal["robstride"] = "robstride"
    id: Annotated[int, Field(ge=1, le=0x7F)]
    """Motor id."""
    host: Annotated[int, Field(ge=0, le=0xFF)] = 0xFD
    """Our id, to which it replies."""
    model: Literal["RS00", "RS01", "RS02", "RS03", "RS04", "RS05", "RS06"]
    """Model as on its label: its frames are scaled by it, and the drive has no register that tells it."""
    kp: Annotated[FiniteFloat, Field(ge=0)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0)]
    """Damping under position control [N·m·s/rad]."""

    @model_validator(mode="after")
    def _gains_fit_the_model(self) -> "RobStrideSettings":
        ranges = RANGES[self.model]
        if self.kp > ranges.kp or self.kd > ranges.kd:
            raise ValueError(f"kp {self.kp} and kd {self.kd}: {self.model} takes kp to {ranges.kp}, kd to {ranges.kd}")
        return self

    @property
    def address(self) -> str:
        return f"motor {self.id}"
