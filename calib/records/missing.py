"""What to do about an arm that has no record of a kind yet."""

from armlink.arm_file import ArmFile
from armlink.errors import Refused


def no_record(arm: ArmFile, kind: str) -> Refused:
    """The refusal of work that needs a record of the `kind`, with the command that leads to one."""
    return Refused(f"{arm.name} {arm.serial}: no {kind} record yet: sweep it first: {first_sweep(arm)}")


def first_sweep(arm: ArmFile) -> str:
    """The command by which every record begins."""
    return f"armlink sweep {arm.argument} --out unloaded"
