"""Arguments and options that commands share, here and in the packages above."""

from pathlib import Path
from typing import Annotated

import typer

Arm = Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")]
OtherBus = Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")]
Json = Annotated[Path | None, typer.Option(help="Write the answer here; - is standard output.")]
