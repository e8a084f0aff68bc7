"""Keys of a MyActuator joint in the arm file."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from armlink.arm_file import Positive
from armlink.drives.myactuator.frames import LAST_ID, RATINGS, torque_constant
from armlink.drives.settings import DriveSettings

LEAST_GEAR = 6.0
"""Of all models: a constant that is smaller by more than its root is nearer to the motor's than to the output's."""


class MyActuatorSettings(DriveSettings):
    """A MyActuator RMD-X drive (V3 protocol)."""

    family: Literal["myactuator"] = "myactuator"
    id: Annotated[int, Field(ge=1, le=LAST_ID)]
    model: str = ""
    """As on the label or as the drive tells it: its torque constant, where the key below does not give it."""
    torque_constant: Positive | None = None
    """Torque at the output for one ampere [N·m/A]; None: rated torque over rated current of the model."""
    timeout_ms: Annotated[int, Field(ge=0, le=2500)] = 0
    """Time-out of communication (B3h) as it was stored in the drive [ms]; 0: none, the drive keeps on."""

    @model_validator(mode="after")
    def _constant_is_known(self) -> "MyActuatorSettings":
        if self.torque_constant is None and self.model not in RATINGS:
            raise ValueError(
                f"model {self.model!r} is unknown: give one of {', '.join(RATINGS)}, or give torque_constant, the "
                "rated torque over the rated current of the data sheet"
            )
        usual = torque_constant(self.model) if self.model in RATINGS else 0.0
        if self.torque_constant is not None and self.torque_constant < usual / math.sqrt(LEAST_GEAR):
            raise ValueError(
                f"torque_constant {self.torque_constant:g} is that of the motor before the gear, by the ratings of an "
                f"{self.model} ({usual:.3g} N·m/A at the output): currents would be too large"
            )
        return self

    @property
    def constant(self) -> float:
        """[N·m/A]."""
        return self.torque_constant or torque_constant(self.model)

    @property
    def address(self) -> str:
        return f"id {self.id}"
