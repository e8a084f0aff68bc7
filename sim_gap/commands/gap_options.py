"""Options about the arm that commands of `armlink gap` share."""

from typing import Annotated, Any

import typer


def _about(help_text: str, **more: Any) -> Any:
    return typer.Option(help=help_text, rich_help_panel="About the arm and the recordings", **more)


Base = Annotated[str | None, _about("Body of the model that carries the recorded arm; default: the world.")]
Tip = Annotated[str | None, _about("Body of the model that the recorded arm ends in, where it has several arms.")]
KnownGain = Annotated[
    str,
    _about(
        "Gains of the position controllers, where the model lacks them: kp=20,kd=1.5 or kp=A;B;… by joint "
        "(N·m/rad, N·m·s/rad).",
        metavar="kp=…,kd=…",
    ),
]
