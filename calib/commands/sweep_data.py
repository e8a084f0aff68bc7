"""Data sets of `armlink sweep`, as commands take them."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from calib.sweep.dataset import SweepData


def load_sweeps(command: str, directories: list[Path], arm: str | None) -> "tuple[list[SweepData], ArmFile]":
    """Data sets and the arm file that they were made with, or `arm`; raises BadInput."""
    from armlink.errors import BadInput
    from calib.sweep.data_sets import data_sets

    if not directories:
        raise BadInput(f"{command}: give the directories that sweep wrote")
    data = data_sets(directories)
    return data, data[0].load_arm(arm)
