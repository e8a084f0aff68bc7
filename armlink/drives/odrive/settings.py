"""Keys of an ODrive joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field

from armlink.drives.settings import DriveSettings


class ODriveSettings(DriveSettings):
    """One ODrive axis (Pro, S1, Micro; firmware 0.6) in CANSimple; positions and torques are the motor's."""

    family: Literal["odrive"] = "odrive"
    node: Annotated[int, Field(ge=0, le=0x3E)]
    """Node id (axis0.config.can.node_id)."""

    @property
    def address(self) -> str:
        """Its id on the bus."""
        return f"node {self.node}"
