"""Arguments and options that commands share, here and in the packages above."""

from pathlib import Path
from typing import Annotated

import typer

Arm = Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")]
OtherBus = Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")]
Json = Annotated[Path | None, typer.Option(help="Write the answer here; - is standard output.")]

READING = "How to read the recordings"
"""Group of the options that correct a recording, in a command's help."""

Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        help="Column of the file for one of ours: t=time,q_1=pos_a or q_1=q_2,q_2=q_1.",
        rich_help_panel=READING,
    ),
]
Joints = Annotated[
    str, typer.Option(help="Joints of the recordings to take, base to tip: a,b,c.", rich_help_panel=READING)
]
Units = Annotated[
    list[str] | None,
    typer.Option(
        help="Unit of a channel: q=deg, q=counts:4096 (a turn), q=percent:110 (degrees at 100), t=ms,"
        " tau_motor=A:12.5 (N·m/A).",
        rich_help_panel=READING,
    ),
]
Sign = Annotated[list[str] | None, typer.Option(help="Sign of a channel or column: tau_3=-1.", rich_help_panel=READING)]
Zero = Annotated[
    list[str] | None, typer.Option(help="Angle to add to a position [rad]: q_2=1.5708.", rich_help_panel=READING)
]
Clock = Annotated[
    list[str] | None, typer.Option(help="Time to add to a channel [s]: tau=-0.02.", rich_help_panel=READING)
]
EffortIs = Annotated[
    str, typer.Option(help="Source of a bag's efforts: motor or link (sensor).", rich_help_panel=READING)
]
Topic = Annotated[str, typer.Option(help="Topic of a bag that holds the joint states.", rich_help_panel=READING)]
