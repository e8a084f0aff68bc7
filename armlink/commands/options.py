"""Arguments and options that commands share, here and in the packages above, and how their help shows them."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

Arm = Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")]
OtherBus = Annotated[str | None, typer.Option(help="INTERFACE:CHANNEL[@BITRATE], instead of the bus in the arm file.")]
Ros2 = Annotated[
    str | None,
    typer.Option(
        "--ros2",
        metavar="TOPIC",
        help="Listen to the joint states of this ROS 2 topic, such as /joint_states.",
        rich_help_panel="Arms that another program commands",
    ),
]
LeRobot = Annotated[
    str | None,
    typer.Option(
        "--lerobot",
        metavar="TYPE:PORT",
        help="Listen to the LeRobot program that runs the robot on this port.",
        rich_help_panel="Arms that another program commands",
    ),
]
Json = Annotated[Path | None, typer.Option(help="Write the answer as JSON to this file; for standard output give `-`.")]


def stated_bus(bus: str | None, ros2: str | None, lerobot: str | None) -> str | None:
    """The bus INTERFACE:CHANNEL that one of these options names; None without any. Raises BadInput for two."""
    from armlink.errors import BadInput

    given = [each for each in (bus, ros2 and f"ros2:{ros2}", lerobot and f"lerobot:{lerobot}") if each]
    if len(given) > 1:
        raise BadInput("--bus, --ros2 and --lerobot: give only one of these options")
    return given[0] if given else None


def _of_reading(help_text: str, *names: str) -> Any:
    """An option that corrects a recording, in a group of its own in a command's help."""
    return typer.Option(*names, help=help_text, rich_help_panel="How to read the recordings")


UNITS = "q=deg, q=counts:4096 (per turn), q=percent:110 (degrees at 100 %), t=ms, tau_motor=A:12.5 (N·m/A)"
Many, Text = list[str] | None, str
OF_READING: dict[str, tuple[Any, Any]] = {
    "columns": (Many, _of_reading("Columns to rename, OURS=THEIRS: t=time,q_1=pos_a or q_1=q_2,q_2=q_1.", "--map")),
    "header": (
        Text, _of_reading("Columns of a table without a header row: t,q_1,q_cmd_1; - leaves one out.", "--columns")
    ),
    "joints": (Text, _of_reading("Joints to take from the recordings, from base to tip: a,b,c.")),
    "units": (Many, _of_reading(f"Unit of a channel: {UNITS}.")),
    "sign": (Many, _of_reading("Sign of a channel or column: tau_3=-1.")),
    "zero": (Many, _of_reading("Angle to add to a position [rad]: q_2=1.5708.")),
    "clock": (Many, _of_reading("Time to add to a channel [s]: tau=-0.02.")),
    "effort_is": (Text, _of_reading("Kind of efforts: motor, link (sensor), without-gravity, motor,without-gravity.")),
    "topic": (Text, _of_reading("Topic of a bag with the joint states.")),
}  # fmt: skip
"""Options that say how a recording is to be read: type and help of each."""


def reads_recordings(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with the options OF_READING in place of its parameter `stated`, which gets the `Corrections`."""
    signature = inspect.signature(command)
    options = [
        inspect.Parameter(
            name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default="" if kind is Text else None,
            annotation=Annotated[kind, option],
        )
        for name, (kind, option) in OF_READING.items()
    ]

    @wraps(command)
    def with_options(**given: Any) -> Any:
        from armlink.recording.corrections import parse_corrections

        return command(stated=parse_corrections(**{name: given.pop(name) for name in OF_READING}), **given)

    parameters = [
        each for one in signature.parameters.values() for each in (options if one.name == "stated" else [one])
    ]
    with_options.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    with_options.__annotations__ = {one.name: one.annotation for one in parameters}
    return with_options


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
