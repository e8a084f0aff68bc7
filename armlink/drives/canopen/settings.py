"""Keys of a CiA 402 joint in the arm file."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from armlink.arm_file import Positive, Section
from armlink.drives.settings import DriveSettings
from armlink.drives.traits import Traits

TRAITS = Traits(
    torque="link", calibration="controller", silence="holds", bounds=("torque", "window"), cadence="sync", frame="11"
)
"""Of a drive with our torque sensor record."""
TYPES = {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "real32": "f"}
"""Names of the arm file → struct codes, little endian."""


class TorqueObject(Section):
    """The object in which a device shows a joint torque sensor that is wired to one of its inputs."""

    object: Annotated[str, Field(pattern=r"^(0x)?[0-9A-Fa-f]{4}(\.[0-9A-Fa-f]{1,2})?$")]
    """Index and sub-index, hexadecimal: 0x3160.1."""
    type: Literal["int8", "uint8", "int16", "uint16", "int32", "uint32", "real32"]
    scale: FiniteFloat
    """Torque of one count [N·m]; the reading is scale · (value − offset)."""
    offset: FiniteFloat = 0.0
    """Value of the object at zero torque."""
    unit: Literal["N·m"] = "N·m"

    @property
    def index(self) -> int:
        return int(self.object.partition(".")[0], 16)

    @property
    def sub(self) -> int:
        return int(self.object.partition(".")[2] or "0", 16)


class CanopenSettings(DriveSettings):
    """A CiA 402 drive; `node` alone is one with our own torque sensor record 2100h."""

    family: Literal["canopen"] = "canopen"
    node: Annotated[int, Field(ge=1, le=127)]
    torque: Literal["record", "motor"] | TorqueObject = "record"
    """Where the joint torque is read: our record 2100h, the drive's own estimate 6077h, or an object of the device."""

    position_unit: Positive | None = None
    """Radians of one count of 6064h at the drive's output; by default as 6092h, 60A8h or 608Fh tell."""
    velocity_unit: Positive | None = None
    """Radians a second of one count of 606Ch; by default as 60A9h tells, else counts of 6064h a second."""

    @model_validator(mode="after")
    def _calibration_has_a_place(self) -> "CanopenSettings":
        if self.calibration == "controller" and self.torque != "record":
            raise ValueError(
                "`calibration: controller` needs `torque: record` (object 2100h): write `calibration: host`"
            )
        return self

    @property
    def address(self) -> str:
        return f"node {self.node}"
