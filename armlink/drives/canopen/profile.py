"""Objects of one device that the link can use, and the PDOs that follow from them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import pdo
from armlink.drives.canopen.cia402 import CYCLIC_VELOCITY, supports
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import Pdo
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.settings import TYPES, CanopenSettings, TorqueObject
from armlink.drives.canopen.units import TORQUE_PER_MICRO
from armlink.drives.orders import Mode

LOST: Mapping[Entry, str] = {
    objects.RPDO_DEADLINE: "the device does not watch the commands of its host",
    objects.HEARTBEAT_CONSUMER: "the device does not watch the heartbeat of its host",
    objects.HEARTBEAT_PRODUCER: "only missing readings show that the device has left the bus",
    objects.ABORT_OPTION: "the reaction of the device to a silent host cannot be set",
    objects.QUICK_STOP_OPTION: "whether the device holds after a quick stop cannot be set",
    objects.MAX_TORQUE: "the device does not limit torque: only the host does",
    objects.POSITION_LOWER: "the device does not limit positions: only the host does",
    objects.POSITION_UPPER: "",
    objects.INTERPOLATION_VALUE: "the device assumes a fixed period between targets, which cannot be set",
    objects.INTERPOLATION_INDEX: "",
    objects.TARGET_TORQUE: "no torque control",
    objects.MOTOR_TORQUE: "no torque reading from the motor's current",
    objects.VELOCITY: "without a velocity reading there is no torque control",
    objects.RATED_TORQUE: "the rated torque is taken from the arm file",
    objects.SUPPORTED_MODES: "only the mode display shows which modes the device supports",
    objects.MODE_DISPLAY: "only the motion of the joint shows that the device refused a mode",
    objects.TORQUE_OFFSET: "the device has no torque offset, so nothing has to be cleared",
    objects.PROFILE_VELOCITY: "no profile position mode",
    objects.TORQUE_SLOPE: "no profile torque mode",
}
"""Objects that a stock device may lack → what is lost by it; empty where another line says it."""


_BY_VELOCITY: Mapping[Entry, Entry | None] = {
    objects.TARGET_POSITION: objects.TARGET_VELOCITY,
    objects.TARGET_TORQUE: None,
}


@dataclass(frozen=True)
class Profile:
    """Objects of one device; by default those of one with our torque sensor record, which has all."""

    absent: frozenset[Entry] = field(default_factory=frozenset)
    reading: Entry | None = objects.TORQUE_READING
    """Object of the joint torque sensor; None: there is none."""
    torque_scale: float = TORQUE_PER_MICRO
    """Torque of one count of it [N·m]."""
    torque_zero: float = 0.0
    """Count of it at zero torque."""
    modes_by_pdo: bool = True
    """Whether 6060h and 6061h can be mapped, so that the mode can change while cycling."""

    def has(self, entry: Entry) -> bool:
        return entry not in self.absent

    position_mode: int = int(Mode.POSITION)
    """Mode of the device in which positions are led: cyclic, else profile position, else cyclic velocity."""
    torque_mode: int = int(Mode.TORQUE)
    """Mode of the device for torque control: cyclic, else profile torque."""

    @property
    def by_velocity(self) -> bool:
        """Whether cyclic velocity is the only mode that serves: target velocities take the place of positions."""
        return self.position_mode == CYCLIC_VELOCITY

    def usable_modes(self, supported: int) -> frozenset[int]:
        """Modes that the device can be ordered in while it cycles, of `supported` ones (bits of 6502h).

        Where its mode cannot be mapped, that is the one that it is left in.
        """
        if self.by_velocity:
            return frozenset((int(Mode.OFF), int(Mode.POSITION)))
        modes = {int(mode) for mode in Mode if supports(supported, mode)}
        stand_ins = ((self.position_mode, Mode.POSITION), (self.torque_mode, Mode.TORQUE))
        modes |= {int(mode) for own, mode in stand_ins if own in modes}
        return frozenset(modes if self.modes_by_pdo else modes & {int(Mode.POSITION), self.position_mode})

    @property
    def lost(self) -> tuple[str, ...]:
        """Functions lost by the lack of objects."""
        told = tuple(f"{entry}: {LOST[entry]}" for entry in LOST if entry in self.absent and LOST[entry])
        if self.by_velocity:
            told = (
                *told,
                "only mode 9 (cyclic velocity) can be used: the host controls positions, and there is no torque "
                "control",
            )
        if self.modes_by_pdo:
            return told
        return (*told, "6060h cannot be mapped: the joint keeps one mode for the whole session")

    @property
    def pdos(self) -> tuple[Pdo, ...]:
        """RPDO1, RPDO2, TPDO1, TPDO2, TPDO3 with the objects that the device has; those without any are left out."""
        found = []
        for each in pdo.LINK_PDOS:
            entries = [self.reading if entry == objects.TORQUE_READING else entry for entry in each.entries]
            if self.by_velocity:
                entries = [_BY_VELOCITY.get(entry, entry) if entry is not None else None for entry in entries]
            held = tuple(entry for entry in entries if entry is not None and self.has(entry))
            if not self.modes_by_pdo:
                held = tuple(entry for entry in held if entry not in (objects.MODE, objects.MODE_DISPLAY))
            if held:
                found.append(replace(each, entries=held))
        return tuple(found)


OURS = Profile()


def profile_of(settings: CanopenSettings) -> Profile:
    """The profile by the arm file alone, as for listening: every optional object is thought to be there."""
    if settings.torque == "record":
        return OURS
    torque = settings.torque
    if not isinstance(torque, TorqueObject):
        return Profile(reading=None)
    entry = Entry(torque.index, torque.sub, TYPES[torque.type], "torque sensor at an input")
    return Profile(reading=entry, torque_scale=torque.scale, torque_zero=torque.offset)


def lacking_objects(services: NodeServices) -> frozenset[Entry]:
    """Optional objects that a device does not have, by asking for each; raises BusFault where it does not answer."""
    return frozenset(entry for entry in LOST if not services.has(entry))


def examine_objects(services: NodeServices, settings: CanopenSettings) -> Profile:
    """The profile of a device, by asking it for each object; one with our record must have them all.

    The node is pre-operational, so that mappings can be tried. Raises BusFault where it does not answer.
    """
    if settings.torque == "record":
        return OURS
    absent = lacking_objects(services)
    sheet = services.remote.object_dictionary
    modes = [sheet.get_variable(entry.index, 0) for entry in (objects.MODE, objects.MODE_DISPLAY)]
    by_pdo = all(each is None or each.pdo_mappable for each in modes) and pdo.accepts_mapping(services, pdo.RPDO2)
    return replace(profile_of(settings), absent=absent, modes_by_pdo=by_pdo)
