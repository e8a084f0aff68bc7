"""What to do about an arm that has no record of a kind yet."""

from armlink.arm_file import ArmFile
from armlink.errors import Refused

MAKERS = {"calibration": "calibrate", "gravity": "identify"}
"""Kind of record → the command that makes it from sweeps."""


def no_record(arm: ArmFile, kind: str) -> Refused:
    """The refusal of work that needs a record of the `kind`, with the commands that lead to one."""
    return Refused(f"{arm.name} {arm.serial}: no {kind} record yet: {way_to(arm, kind)}")


def way_to(arm: ArmFile, *kinds: str) -> str:
    """The commands that make records of these kinds, from the first."""
    made = " and ".join(MAKERS[kind] for kind in kinds)
    return f"sweep the arm, then {made}: armlink sweep {arm.argument} --out unloaded"
