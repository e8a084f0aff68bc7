"""Makes an earlier record of an arm the current one again, and writes it to the controllers if asked to."""

import getpass
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from calib.records.records import CalibrationRecord
    from calib.records.store import RecordStore


def rollback(
    arm: Annotated[str, typer.Argument(help="Bundled arm or path of an arm file.")],
    to: Annotated[str, typer.Option(help="Id of a record that was current before (armlink history ARM).")],
    reason: Annotated[str, typer.Option(help="Why; kept in the log.")] = "rollback",
    apply: Annotated[
        bool, typer.Option("--apply", help="Also write its gains and offsets to the controllers.")
    ] = False,
    bus: Annotated[str | None, typer.Option(help="With --apply: INTERFACE:CHANNEL[@BITRATE].")] = None,
    store: Annotated[
        str | None, typer.Option(help="Record store: file or database URL; default: state folder.")
    ] = None,
) -> None:
    """Go back to an earlier record: a new line of the log, nothing is deleted.

    Example: armlink rollback sarcos --to 1f0c9a2b --reason "sensor exchanged" --apply
    """
    from armlink.arm_file import load_arm
    from armlink.errors import BadInput
    from calib.records.records import CalibrationRecord
    from calib.records.store import RecordStore

    arm_file, records, user = load_arm(arm), RecordStore(store), getpass.getuser()
    if apply:
        record = records.get(to).require(arm_file)
        if not isinstance(record, CalibrationRecord):
            raise BadInput(f"--apply: record {to} is a {record.kind} record; controllers hold calibrations only")
        if record != records.current(CalibrationRecord, arm_file):  # what is current may be written once more
            records.former(arm_file, to)
        _apply(arm_file, record, records, bus, user, reason)
    else:
        records.rollback(arm_file, to, by=user, reason=reason)
    line = records.activations(arm_file)[-1]
    typer.echo(f"{line.kind} record {to} is current on {arm_file.name} {arm_file.serial} since {line.at}", err=True)
    if line.kind == "calibration" and not apply:
        typer.echo("the joint controllers keep what they hold; --apply writes it to them", err=True)


def _apply(
    arm_file: "ArmFile", record: "CalibrationRecord", records: "RecordStore", bus: str | None, user: str, reason: str
) -> None:
    """Write the record to every controller, read back, and make it current; the joints need not be enabled."""
    from armlink.link.link import Link
    from calib.install.journaled_write import install

    with Link.open(arm_file, bus) as link:
        link.start()
        written = install(record, arm_file, records, link, by=user, reason=reason)
    typer.echo(f"written to {len(written)} controllers and read back", err=True)
