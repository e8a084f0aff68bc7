"""Says what is missing or doubtful between an arm file, this machine and its bus, first things first."""

from pathlib import Path
from typing import Annotated

import typer

from armlink.commands.options import Arm, OtherBus
from calib.commands.options import JsonFile

COLOURS = {"error": "red", "warning": "yellow", "hint": "cyan"}


def doctor(
    arm: Arm,
    bus: OtherBus = None,
    offline: Annotated[bool, typer.Option("--offline", help="Do not open the bus.")] = False,
    json_file: JsonFile = None,
) -> int:
    """Examine an arm file, its model, the sweeps that it allows, and the drives on its bus, which are only read.

    Findings come in the order in which to deal with them; each names its remedy. Exit status 1 if there is an error.

    Example: armlink doctor sarcos --json -
    """
    from rich.text import Text

    from armlink.arm_file import load_arm
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, command_line, results, suggest
    from armlink.content.printable_text import printable_text
    from armlink.loop.open import first_check, is_in_process
    from calib.commissioning.doctor import examine

    console = results(json_file)
    with PlainConsole().status(f"examining {arm}"):
        findings = examine(arm, bus, offline)
    for found in findings:
        said = f": {found}".replace(f"{Path.cwd()}/", "")
        console.print(Text.assemble((found.level, COLOURS[found.level]), printable_text(said)))
    errors = sum(found.level == "error" for found in findings)
    if errors:
        console.print(f"{errors} {'error' if errors == 1 else 'errors'} to correct first")
    else:
        console.print("no errors")
        own = load_arm(arm)
        rehearsed = is_in_process(own, bus)
        suggest(command_line("demo", arm=arm) if rehearsed else command_line(*first_check(own, arm, bus), bus=bus))
    write_json(json_file, {"schema": "armlink.doctor/1", "arm": arm, "findings": [vars(each) for each in findings]})
    return 1 if errors else 0
