"""Keys of a moteus joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field

from armlink.arm_file import Positive
from armlink.drives.settings import DriveSettings


class MoteusSettings(DriveSettings):
    """A moteus controller, on a bus with `fd: true`."""

    family: Literal["moteus"] = "moteus"
    id: Annotated[int, Field(ge=1, le=0x7E)]
    """Controller id (id.id)."""
    source: Annotated[int, Field(ge=0, le=0x7F)] = 0
    """Our id, to which it replies."""
    torque_constant: Positive | None = None
    """Torque constant at its output [N·m/A], by which the scale check compares torque
    with current; None: not compared."""

    @property
    def address(self) -> str:
        """Its id on the bus."""
        return f"controller {self.id}"
