"""The drives of one family on one bus, which share its frames."""

from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

from sim_bus.drives.simulated_drive import SimulatedDrive

D = TypeVar("D", bound=SimulatedDrive)


class Front(Protocol):
    """The drives of one family on one bus."""

    @property
    def drives(self) -> Sequence[SimulatedDrive]:
        """In arm order."""
        ...

    def on_frame(self, can_id: int, data: bytes) -> None:
        """A frame from the bus."""
        ...

    def joint_of(self, can_id: int) -> int | None:
        """Joint whose drive sends frames of this identifier, or None."""
        ...


class AddressedFront(Generic[D]):
    """All drives of a family on one bus: which of them a frame is for. A family says where the address stands."""

    def __init__(self, drives: list[D]) -> None:
        """`drives` in arm order, each with an address of its own."""
        self.drives = drives
        self._addressed = {drive.address: drive for drive in drives}

    def joint_at(self, address: int) -> int | None:
        """Joint of the drive with this address."""
        drive = self._addressed.get(address)
        return None if drive is None else drive.joint
