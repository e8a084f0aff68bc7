"""Set-up of drives with the MIT law: the window that their frames can carry, and the result."""

from collections.abc import Sequence

from armlink.drives.mit_packing import Ranges
from armlink.drives.orders import Gains, Limits, Mode, ReadingRange, Setup
from armlink.errors import BadInput

MODES = frozenset((int(Mode.POSITION), int(Mode.TORQUE)))


def require_window(name: str, limits: Limits, ranges: Ranges, where: str = "") -> None:
    """Raise BadInput unless a joint's position window lies within the range of its drive's frames, which is `where`."""
    if not (-ranges.position <= limits.lower and limits.upper <= ranges.position):
        raise BadInput(
            f"{name}: its position window {limits.lower:.2f} to {limits.upper:.2f} rad at the drive exceeds the range "
            f"±{ranges.position:.2f} rad of its frames{where}: correct zero and direction, or limit the joint"
        )


def mit_setup(
    position: float,
    kp: float,
    kd: float,
    ranges: Ranges,
    notes: Sequence[str],
    where: tuple[str, str, str],
    remedy: str,
) -> Setup:
    """Set-up of a drive without power at `position` [rad], with the gains of its position control.

    `where` the ranges of position, velocity and torque come from, and how they are made larger.
    """
    quantities = zip(("position", "velocity", "torque"), ranges[:3], where, strict=True)
    return Setup(
        position=position,
        torque=0.0,
        position_step=ranges.position_quantum,
        modes=MODES,
        gains=Gains(kp, kd, ranges.kp, ranges.kd),
        notes=tuple(notes),
        scales={
            "position range, rad": ranges.position,
            "velocity range, rad/s": ranges.velocity,
            "torque range, N·m": ranges.torque,
        },
        ranges=tuple(ReadingRange(*each, remedy) for each in quantities),
    )
