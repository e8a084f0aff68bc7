"""Keys of a Damiao joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from armlink.drives.settings import DriveSettings


class DamiaoSettings(DriveSettings):
    """A Damiao DM-J drive in MIT mode."""

    family: Literal["damiao"] = "damiao"
    id: Annotated[int, Field(ge=1, le=0xFF)]
    """Command id (ESC_ID, register 8)."""
    reply: Annotated[int, Field(ge=0, le=0x7FE)]
    """Reply id (MST_ID, register 7)."""
    model: str = ""
    """Model as on its label, for example DM8009; it is for people, the scales are read from the drive."""
    kp: Annotated[FiniteFloat, Field(ge=0, le=500)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0, le=5)]
    """Damping under position control [N·m·s/rad]; 0 with kp makes the motor oscillate."""

    @property
    def address(self) -> str:
        """Its id on the bus."""
        return f"id {self.id:02X}h"
