"""Keys of a joint's drive in the arm file that all families have; each family adds its own."""

from typing import Literal

from pydantic import FiniteFloat

from armlink.arm_file import Positive, Section
from armlink.drives.traits import CalibrationPlace


class DriveSettings(Section):
    """`link.joints[].drive`: a family extends it by ids, model and gains. Unknown keys are errors."""

    family: str
    direction: Literal[1, -1] = 1
    """Sense of the drive's output against the joint's."""
    zero: FiniteFloat = 0.0
    """Reading of the drive at joint position 0 [rad], at the drive's output."""
    gear: Positive = 1.0
    """Turns of the drive's output for one of the joint, where a further gear follows it."""
    turns: Literal["refuse", "auto"] = "refuse"
    """The treatment of a drive that reads its joint beyond the stops by whole turns of its output: it is refused, or
    `zero` is corrected by them at each start, where one number of turns alone puts the joint between its stops."""
    calibration: CalibrationPlace | None = None
    """Who applies gain and offset of the torque reading; None: as the family's traits have it."""

    @property
    def address(self) -> str:
        """Its id on the bus, unique among the drives of a bus: `node 5`, `id 02h`."""
        raise NotImplementedError
