"""Makes an earlier record of an arm the current one again."""

import getpass
from typing import Annotated

import typer


def rollback(
    arm: Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")],
    to: Annotated[str, typer.Option(help="Id of a record that was current before (armlink history ARM).")],
    reason: Annotated[str, typer.Option(help="Why; kept in the log.")] = "rollback",
    store: Annotated[
        str | None, typer.Option(help="Record store: file or database URL; default: state folder.")
    ] = None,
) -> None:
    """Go back to an earlier record: a new line of the log, nothing is deleted; controllers are not written here.

    Example: armlink rollback sarcos --to 1f0c9a2b
    """
    from armlink.armfile import load_arm
    from calib.store import RecordStore

    arm_file = load_arm(arm)
    line = RecordStore(store).rollback(arm_file, to, by=getpass.getuser(), reason=reason)
    typer.echo(
        f"{line.kind} record {line.record} is current on {arm_file.name} {arm_file.serial} since {line.at}", err=True
    )
    if line.kind == "calibration":
        typer.echo("the joint controllers keep what they hold until armlink calibrate --apply", err=True)
