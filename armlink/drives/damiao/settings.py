"""Keys of a Damiao joint in the arm file, and the ranges of its models."""

import re
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, field_validator

from armlink.drives.mit_packing import Ranges
from armlink.drives.settings import DriveSettings


class DamiaoSettings(DriveSettings):
    """A Damiao DM-J drive in MIT mode."""

    family: Literal["damiao"] = "damiao"
    id: Annotated[int, Field(ge=1, le=0xFF)]
    """Command id (ESC_ID, register 8)."""
    reply: Annotated[int, Field(ge=0, le=0x7FE)]
    """Reply id (MST_ID, register 7)."""
    model: str = ""
    """Model as on its label, for example DM8009 or DM-J8009P-2EC, kept in its short form; a host that only listens
    takes the scales of its frames from it, until it has heard the drive's own."""
    kp: Annotated[FiniteFloat, Field(ge=0, le=500)]
    """Stiffness under position control, at the drive's output [N·m/rad]."""
    kd: Annotated[FiniteFloat, Field(ge=0, le=5)]
    """Damping under position control [N·m·s/rad]; 0 with kp makes the motor oscillate."""

    @field_validator("model")
    @classmethod
    def _is_known(cls, label: str) -> str:
        model = model_on_label(label)
        if label and model is None:
            raise ValueError(f"Damiao model {label!r} is unknown; there are {', '.join(MODELS)} (or leave `model` out)")
        return model or ""

    @property
    def address(self) -> str:
        return f"id {self.id:02X}h"


MODELS: dict[str, Ranges] = {
    "DM3507": Ranges(12.566, 50.0, 5.0),
    "DM4310": Ranges(12.5, 30.0, 10.0),
    "DM4310P": Ranges(12.5, 50.0, 10.0),
    "DM4340": Ranges(12.5, 10.0, 28.0),
    "DM4340P": Ranges(12.5, 10.0, 28.0),
    "DM6006": Ranges(12.5, 45.0, 20.0),
    "DM8006": Ranges(12.5, 45.0, 40.0),
    "DM8009": Ranges(12.5, 45.0, 54.0),
    "DM10010": Ranges(12.5, 20.0, 200.0),
    "DM10010L": Ranges(12.5, 25.0, 200.0),
    "DMH3510": Ranges(12.5, 280.0, 1.0),
    "DMH6215": Ranges(12.5, 45.0, 10.0),
    "DMG6220": Ranges(12.5, 45.0, 10.0),
    "DM6248P": Ranges(12.566, 20.0, 120.0),
}
"""Ranges as delivered, by the name on the label: PMAX [rad], VMAX [rad/s], TMAX [N·m] (registers 21 to 23).

They are taken only where the drive cannot be asked: to listen beside another host, until its registers are heard. A
start always reads the registers. Source: the maker's register defaults as in python-damiao-driver 1.0.6 and DM_CAN.py.
"""
LABEL = re.compile(r"DM-?(?P<kind>[JHG]?)(?P<size>\d{4,5})(?P<variant>[A-Z]?)(-?2EC)?([ _-]?(24|48)V)?([ _-]?V[\d.]+)?")
"""A label, such as DM-J4340P-2EC V1.1."""


def model_on_label(label: str) -> str | None:
    """Key of `MODELS` for a label, in whatever case; None for one that is not known.

    Ranges differ by size; a variant that has none of its own has those of its size.
    """
    found = LABEL.fullmatch(label.strip().upper())
    if found is None:
        return None
    size = f"DM{found['kind'].replace('J', '')}{found['size']}"
    return next((model for model in (size + found["variant"], size) if model in MODELS), None)
