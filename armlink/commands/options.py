"""Arguments and options that commands share, here and in the packages above, and how their help shows them."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

Arm = Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")]
OtherBus = Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the arm file's.")]
Json = Annotated[Path | None, typer.Option(help="Write the answer here; - is standard output.")]


def _of_reading(help_text: str, *names: str) -> Any:
    """An option that corrects a recording, in a group of its own in a command's help."""
    return typer.Option(*names, help=help_text, rich_help_panel="How to read the recordings")


Columns = Annotated[
    list[str] | None,
    _of_reading("Column of the file for one of ours: t=time,q_1=pos_a or q_1=q_2,q_2=q_1.", "--map"),
]
Header = Annotated[
    str, _of_reading("Columns of a table without a header row: t,q_1,q_cmd_1; - is one to leave out.", "--columns")
]
Joints = Annotated[str, _of_reading("Joints of the recordings to take, base to tip: a,b,c.")]
UNITS = "q=deg, q=counts:4096 (a turn), q=percent:110 (degrees at 100), t=ms, tau_motor=A:12.5 (N·m/A)"
Units = Annotated[list[str] | None, _of_reading(f"Unit of a channel: {UNITS}.")]
Sign = Annotated[list[str] | None, _of_reading("Sign of a channel or column: tau_3=-1.")]
Zero = Annotated[list[str] | None, _of_reading("Angle to add to a position [rad]: q_2=1.5708.")]
Clock = Annotated[list[str] | None, _of_reading("Time to add to a channel [s]: tau=-0.02.")]
EffortIs = Annotated[str, _of_reading("The efforts are: motor, link (sensor), without-gravity (or both).")]
Topic = Annotated[str, _of_reading("Topic of a bag that holds the joint states.")]


class GroupedCommand(TyperCommand):
    """A command whose help is plain text, so that units in brackets stay, with options grouped by `rich_help_panel`."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group; options without one come first."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None:
                common = "Arguments" if param.param_type_name == "argument" else "Options"
                sections.setdefault(getattr(param, "rich_help_panel", None) or common, []).append(record)
        for title, records in sections.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)
