"""Arguments and options that several commands share."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from calib.dataset import SweepData
    from calib.records.store import RecordStore
    from gcomp.arrays import Array

ArmOrModel = Annotated[str, typer.Argument(help="Bundled arm, path of an arm file, or a URDF or MJCF file.")]
ChainBase = Annotated[
    str | None,
    typer.Option("--base", help="Body of the model file that carries the chain; by default the world."),
]
ChainTip = Annotated[
    str | None,
    typer.Option("--tip", help="Last body of the chain in the model file; by default the last body that moves."),
]
Sweeps = Annotated[list[Path], typer.Argument(help="Data sets of sweeps, with and without a reference mass.")]
SweepsArm = Annotated[
    str | None, typer.Option("--arm", help="Arm file, if it is no longer where it was during the sweep.")
]
APPLY = "With --apply"
"""Group of the options that only count when a record is written to the controllers, in a command's help."""
Bus = Annotated[
    str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE]; default: bus of the arm file.", rich_help_panel=APPLY)
]
Check = Annotated[
    bool,
    typer.Option(
        help="Move every joint a little before and after writing; write the old calibration back if the new one "
        "fits worse.",
        rich_help_panel=APPLY,
    ),
]
Flash = Annotated[
    bool,
    typer.Option("--flash", help="Also store the values in the flash memory of the drives.", rich_help_panel=APPLY),
]
Replaced = Annotated[
    list[str] | None,
    typer.Option(
        help="Joint whose sensor was exchanged since the last record; may be repeated.", rich_help_panel=APPLY
    ),
]


def _use_store(store: str | None) -> str | None:
    """The store of whatever the command opens: the link and the process on the bus take calibrations from it, too."""
    if store is not None:
        os.environ["ARMLINK_STORE"] = store
    return store


Store = Annotated[
    str | None,
    typer.Option(
        envvar="ARMLINK_STORE",
        callback=_use_store,
        help="Record store: file or database URL; by default in the user's state folder.",
    ),
]
KeepGoing = Annotated[
    int,
    typer.Option(
        min=0,
        help="Number of stalls of the cycle after which the joints are enabled again without asking.",
        rich_help_panel="Run",
    ),
]
WithoutAsking = Annotated[bool, typer.Option("--yes", help="Move the arm without asking first.", rich_help_panel="Run")]
JsonFile = Annotated[
    Path | None, typer.Option("--json", help="Write the answer as JSON to this file; for standard output give `-`.")
]


Tool = Annotated[
    str | None,
    typer.Option(
        "--tool",
        metavar="MASS,X,Y,Z",
        help="Tool that the arm carries: mass [kg] and its centre [m] in the frame that turns with the last joint; 0 "
        "for none. By default the arm file's.",
    ),
]


def gravity_model(arm_file: "ArmFile", record: str | None, records: "RecordStore") -> "tuple[Array, str] | None":
    """Mass moments (2n,) [kg·m] of the given or current record, and their origin; None if there is no record.

    Raises BadInput if the record is no gravity record, Refused if it belongs to another arm.
    """
    import numpy as np

    from armlink.errors import BadInput
    from calib.records.records import GravityRecord

    kept = records.current(GravityRecord, arm_file) if record is None else records.usable(record, arm_file)
    if kept is None:
        return None
    if not isinstance(kept, GravityRecord):
        raise BadInput(f"--record {record}: this is a {kept.kind} record, expected a gravity record")
    return np.array(kept.carrying(arm_file).beta), f"gravity record {kept.id}"


def load_sweeps(directories: list[Path], arm: str | None) -> "tuple[list[SweepData], ArmFile]":
    """Data sets and the arm file that they were made with, or `arm`; raises BadInput."""
    from calib.dataset import data_sets

    data = data_sets(directories)
    return data, data[0].load_arm(arm)
