"""Options that the commands which write to controllers share."""

from pathlib import Path
from typing import Annotated

import typer

Bus = Annotated[str | None, typer.Option(help="With --apply: INTERFACE:CHANNEL[@BITRATE].")]
Check = Annotated[
    bool, typer.Option(help="With --apply: a small motion of every joint before and after; worse is taken back.")
]
Flash = Annotated[bool, typer.Option("--flash", help="With --apply: also store to the controllers' flash.")]
Replaced = Annotated[
    list[str] | None, typer.Option(help="With --apply: a joint whose sensor was exchanged since the last record.")
]
Store = Annotated[str | None, typer.Option(help="Record store: file or database URL.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="Write the answer here; - is standard output.")]
