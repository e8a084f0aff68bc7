"""Writes the policy of a guard, which alone has the bus and passes only what the arm file's limits allow."""

from pathlib import Path
from typing import Annotated

import typer

from armlink.commands.options import OtherBus


def guard(
    arm: Annotated[str | None, typer.Argument(help="Bundled arm or path of an arm file.")] = None,
    out: Annotated[Path | None, typer.Option(help="JSON file to write; required unless --path is given.")] = None,
    path: Annotated[bool, typer.Option("--path", help="Print only the path of the guard's Python file.")] = False,
    bus: OtherBus = None,
) -> int:
    """Write the policy of a guard of this arm's bus: which frames may pass, with bounds of torque and position.

    The drives are read for their scales and objects; nothing is set. The guard itself is one file without dependencies:
    only the guard uses the bus of the arm; programs use another interface, and the guard checks each of their frames.

    Example: armlink guard sarcos --bus socketcan:vcan0 --out sarcos.guard.json
    """
    from armlink.arm_file import load_arm
    from armlink.commands.output import write_json, write_out
    from armlink.commands.plain_console import PlainConsole, results, suggest
    from armlink.errors import BadInput
    from armlink.guard import bus_guard
    from armlink.link.link import Link

    if path:
        write_out(f"{bus_guard.__file__}\n")
        return 0
    if arm is None or out is None:
        raise BadInput("guard: give an arm file and `--out POLICY`, or `--path`")
    described = load_arm(arm)
    with Link.open(described, bus) as link:
        rules = link.guard_rules()
    write_json(out, {"schema": bus_guard.SCHEMA, "arm": described.name, "serial": described.serial, **rules})
    results(out).print(f"{out}: the policy lets {len(rules['frames'])} identifiers pass")
    suggest(f"python3 -I {bus_guard.__file__} {out} arm0 can0")
    PlainConsole().print(
        "This command starts the guard between arm0, the interface for programs (make it with `ip link add arm0 "
        "type vcan`), and can0, the bus of the arm."
    )
    return 0
