"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

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
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the answer here; - is standard output.")]
