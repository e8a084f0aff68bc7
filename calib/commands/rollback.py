"""Makes an earlier record of an arm the current one again; --apply also writes it to the controllers."""

import getpass
from typing import TYPE_CHECKING, Annotated

import typer

from armlink.commands.options import Arm
from calib.commands.options import Bus, Check, Replaced, Store

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from calib.install.apply import Apply
    from calib.records.store import RecordStore


def rollback(
    arm: Arm,
    to: Annotated[str, typer.Option(help="Id of a record that was current before; `history` lists them.")],
    reason: Annotated[str, typer.Option(help="Reason for the roll-back, written to the log.")] = "rollback",
    apply: Annotated[
        bool, typer.Option("--apply", help="Also write gains and offsets of the record to the drives.")
    ] = False,
    bus: Bus = None,
    check: Check = True,
    replaced: Replaced = None,
    store: Store = None,
) -> None:
    """Make an earlier record current again; this adds a line to the log, and nothing is deleted.

    Example: armlink rollback sarcos --to 1f0c9a2b --reason "sensor exchanged" --apply
    """
    from armlink.arm_file import load_arm
    from armlink.commands.early_end import early_end
    from armlink.commands.plain_console import PlainConsole, command_line, results, suggest
    from calib.records.store import RecordStore

    arm_file, records, user = load_arm(arm), RecordStore(store), getpass.getuser()
    if apply:
        from calib.install.apply import Apply

        how = Apply(by=user, bus=bus, check=check, replaced=tuple(replaced or ()))
        with early_end(arm_file, command_line("rollback", arm, "--apply", to=to, bus=bus, store=store)) as work:
            work.enabled = check
            _apply(arm_file, to, records, how, reason)
    else:
        records.rollback(arm_file, to, by=user, reason=reason)
    line = [each for each in records.activations(arm_file) if each.record == to][-1]
    results().print(f"{line.kind} record {to} is current on {arm_file.name} {arm_file.serial} since {line.at}")
    if line.kind == "calibration" and not apply:
        PlainConsole().print(
            "The drives keep their present calibration. A daemon with policy `apply` writes this record to "
            "them within seconds."
        )
        suggest(command_line("rollback", arm, "--apply", to=to, bus=bus, store=store))


def _apply(arm_file: "ArmFile", to: str, records: "RecordStore", how: "Apply", reason: str) -> None:
    from armlink.commands.plain_console import results
    from armlink.errors import BadInput
    from calib.install.apply import apply_rollback
    from calib.records.records import CalibrationRecord

    record = records.usable(to, arm_file)
    if not isinstance(record, CalibrationRecord):
        raise BadInput(f"--apply: record {to} is a {record.kind} record, but drives store calibrations only")
    if record != records.current(CalibrationRecord, arm_file):  # the current one may be written once more
        records.former(arm_file, to)
    written = apply_rollback(record, arm_file, records, how, reason)
    gate = "a roll-back has one check: the distance of its values from the values that the drives held before"
    results().print(f"written to {len(written)} drives and read back; {gate}")
