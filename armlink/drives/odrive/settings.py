"""Keys of an ODrive joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field

from armlink.arm_file import Positive
from armlink.drives.settings import DriveSettings


class ODriveSettings(DriveSettings):
    """One ODrive axis (Pro, S1, Micro; firmware 0.6) in CANSimple; positions and torques are the motor's."""

    family: Literal["odrive"] = "odrive"
    node: Annotated[int, Field(ge=0, le=0x3E)]
    """Node id (axis0.config.can.node_id)."""
    torque_constant: Positive | None = None
    """Torque constant of the motor, 8.27 / KV [N·m/A], by which the scale check compares torque
    with current; None: not compared."""

    @property
    def address(self) -> str:
        """Its id on the bus."""
        return f"node {self.node}"
