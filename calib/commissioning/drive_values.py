"""Values that an arm file needs of a drive, and that the drive does not tell: gains and ratings, each with a note."""

import math
from collections.abc import Callable
from dataclasses import replace

from armlink.drives.findings import FoundDrive
from calib.commissioning.draft import LEAST_TORQUE
from calib.commissioning.motion_checks import LEAST_DAMPING


def with_gains(drive: FoundDrive, inertia: float = 0.0) -> FoundDrive:
    """The drive with kp and kd, where it takes them: the torque range over one radian, and a tenth of that, or the
    damping that `armlink doctor` asks for at this inertia [kg·m²]; kp is lowered where no kd that it takes suffices."""
    if drive.largest_gains is None or drive.drive is None:
        return drive
    most_kp, most_kd = drive.largest_gains
    kp = min(drive.max_torque, most_kp) if math.isfinite(drive.max_torque) else LEAST_TORQUE
    needed = 2 * LEAST_DAMPING * math.sqrt(kp * inertia)
    kd = min(max(kp / 10, needed), most_kd)
    if kd < needed:
        kp = (kd / (2 * LEAST_DAMPING)) ** 2 / inertia
    gains = {"kp": _rounded(kp, math.floor), "kd": min(_rounded(kd, math.ceil), most_kd)}
    return replace(drive, drive={**drive.drive, **gains})


def _rounded(value: float, to_whole: Callable[[float], int]) -> float:
    """Two digits, in the direction of `to_whole`."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{to_whole(value / step) * step:.2g}")


def assumed_ratings(drive: FoundDrive) -> FoundDrive:
    """The drive with a rated torque, and no larger one allowed, where it tells none: a third of its range, from where
    on `armlink doctor` warns."""
    if math.isfinite(drive.rated_torque):
        return drive
    rated = drive.max_torque / 3 if math.isfinite(drive.max_torque) else LEAST_TORQUE
    return replace(drive, rated_torque=float(f"{rated:.2g}"), max_torque=float(f"{rated:.2g}"))


def drive_notes(drive: FoundDrive, rating: bool = True) -> list[str]:
    """Comments for the arm file; `rating`: its ratings are assumed as well."""
    notes = [drive.note, drive.wrong]
    if drive.largest_gains is not None:
        notes.append("kp, kd assumed: the torque range over one radian, with the damping that armlink doctor asks for")
    if rating and not math.isfinite(drive.rated_torque):
        notes.append("rated_torque, max_torque assumed: the drive does not tell them; take them from its data sheet")
    return [note for note in notes if note]
