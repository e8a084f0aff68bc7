"""Arguments and options that several commands share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from calib.sweep.dataset import SweepData

Sweeps = Annotated[list[Path], typer.Argument(help="Data sets of sweep, without and with load.")]
SweepsArm = Annotated[str | None, typer.Option("--arm", help="Arm file, if it is no longer where sweep found it.")]
Bus = Annotated[str | None, typer.Option(help="With --apply: INTERFACE:CHANNEL[@BITRATE].")]
Check = Annotated[
    bool,
    typer.Option(help="With --apply: a small motion of every joint before and after; a worse result is rolled back."),
]
Flash = Annotated[bool, typer.Option("--flash", help="With --apply: also store to the controllers' flash.")]
Replaced = Annotated[
    list[str] | None, typer.Option(help="With --apply: a joint whose sensor was exchanged since the last record.")
]
Store = Annotated[str | None, typer.Option(help="Record store: file or database URL; default: state folder.")]
StoreUrl = Annotated[str | None, typer.Option(help="Record store: file or database URL.")]
KeepGoing = Annotated[
    int, typer.Option(min=0, help="Enable the joints again by itself up to N times after a stall of the cycle.")
]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the answer here; - is standard output.")]


def load_sweeps(command: str, directories: list[Path], arm: str | None) -> "tuple[list[SweepData], ArmFile]":
    """Data sets and the arm file that they were made with, or `arm`; raises BadInput."""
    from armlink.errors import BadInput
    from calib.sweep.dataset import data_sets

    if not directories:
        raise BadInput(f"{command}: give the directories that sweep wrote")
    data = data_sets(directories)
    return data, data[0].load_arm(arm)
