"""Opens buses by name, `INTERFACE:CHANNEL[@BITRATE]`, for any interface of python-can."""

from typing import Any

from armlink.arm_file import Bus, LinkSection
from armlink.bus.bus_group import BusGroup
from armlink.bus.can_bus import MessageBus
from armlink.bus.listening.joint_messages import ListeningBus, message_names
from armlink.bus.port import interface_fault
from armlink.errors import BadInput
from armlink.extras import require_extra

VIRTUAL_INTERFACES = ("virtual", "udp_multicast")
EXTRAS = {"udp_multicast": "simulator"} | dict.fromkeys(
    ("damiao_serial", "gs_usb", "robotell", "robstride_serial", "seeedstudio", "serial", "slcan"), "adapters"
)
"""Interface → the extra that brings what python-can needs for it."""
LISTENING_INTERFACES = ("lerobot", "ros2")
"""Messages of a program that commands the arm, in place of a bus: they can only be listened to."""
FORM = "INTERFACE:CHANNEL[@BITRATE], for example socketcan:can0@1000000, or with CAN FD socketcan:can0@1000000/5000000"


def parse_bus(spec: str, default_bitrate: int = 1_000_000) -> Bus:
    """Parse a bus specification; raises BadInput with the expected form."""
    interface, colon, rest = spec.partition(":")
    channel, at, rates = rest.partition("@")
    bitrate, fd, data_bitrate = rates.partition("/")
    if not (interface and colon and channel):
        raise BadInput(f"bus {spec!r}: expected {FORM}")
    if at and not all(each.isdigit() and int(each) > 0 for each in (bitrate, data_bitrate if fd else bitrate)):
        raise BadInput(f"bus {spec!r}: bit rate {rates!r}, expected bits per second: {FORM}")
    keys: dict[str, Any] = {"fd": True, "options": {"data_bitrate": int(data_bitrate)}} if fd else {}
    return Bus(interface=interface, channel=channel, bitrate=int(bitrate) if at else default_bitrate, **keys)


def resolve_bus(spec: str | None, section: Bus) -> Bus:
    """Bus named on the command line, with the arm file's options if the interface is the same; else the arm file's."""
    if spec is None:
        return section
    bus = parse_bus(spec, section.bitrate)
    if bus.fd or bus.interface != section.interface:
        return bus
    return bus.model_copy(update={"fd": section.fd, "options": section.options})


def is_virtual(bus: Bus) -> bool:
    """Whether a bus that other programs can open has no wire, and no bit rate."""
    return bus.interface in VIRTUAL_INTERFACES or (bus.interface == "socketcan" and bus.channel.startswith("vcan"))


def is_listening(bus: Bus) -> bool:
    """Whether a bus carries messages of another program, and can only be listened to."""
    return bus.interface in LISTENING_INTERFACES


def open_listening_bus(bus: Bus, section: LinkSection) -> ListeningBus:
    """Messages about the joints of an arm's link; raises BadInput, BusFault."""
    name = f"{bus.interface}:{bus.channel}"
    joints = message_names(section)
    if bus.interface == "ros2":
        require_extra(f"bus {name}", "ros2")
        from armlink.bus.listening.ros2 import RosTopic

        return ListeningBus(RosTopic(bus.channel), name, joints, rate=section.rate)
    from armlink.bus.listening.lerobot import open_robot

    source, torque_constants = open_robot(bus.channel)
    return ListeningBus(source, name, joints, torque_constants, section.rate)


def open_bus(spec: str | None, section: Bus) -> MessageBus:
    """Open the bus that `spec` names, by default that of the arm file's section.

    Raises BadInput for a malformed specification or an unknown interface, BusFault if the bus does not exist or cannot
    be opened.
    """
    bus = resolve_bus(spec, section)
    if is_listening(bus):
        raise BadInput(
            f"bus {bus.interface}:{bus.channel}: this bus is listen-only: use record, monitor, observe, or "
            "daemon --listen-only, with an arm file"
        )
    import can
    from can.exceptions import CanInterfaceNotImplementedError

    from armlink.bus.adapters import adapt

    name = f"{bus.interface}:{bus.channel}"
    options: dict[str, Any] = {} if bus.interface == "socketcan" else {"bitrate": bus.bitrate}
    if bus.fd:
        options |= {"protocol": can.CanProtocol.CAN_FD} if bus.interface == "virtual" else {"fd": True}
    try:
        return adapt(can.Bus(interface=bus.interface, channel=bus.channel, **options, **bus.options), name)
    except CanInterfaceNotImplementedError as error:
        if bus.interface in EXTRAS:  # python-can has the interface, which lacks what it is made of
            require_extra(f"bus {name}", EXTRAS[bus.interface])
        known = bus.interface in can.VALID_INTERFACES
        hint = "install the driver of this interface" if known else "python-can does not know this interface"
        raise BadInput(f"bus {name}: {error}: {hint}") from None
    except TypeError as error:
        raise BadInput(
            f"bus {name}: link.bus.options has an option that the interface does not accept: {error}"
        ) from None
    except Exception as error:
        raise interface_fault(error, name, "open it") from None


def open_link_bus(spec: str | None, section: LinkSection) -> MessageBus:
    """Open the bus of an arm's link, several buses as a BusGroup; `spec` puts every joint on one bus.

    Raises as open_bus.
    """
    if is_listening(resolved := resolve_bus(spec, section.bus)):
        return open_listening_bus(resolved, section)
    names = list(dict.fromkeys(joint.bus for joint in section.joints))
    if spec is not None or names == [""]:
        return open_bus(spec, section.bus)
    members: list[MessageBus] = []
    try:
        for name in names:
            member = open_bus(None, section.buses[name] if name else section.bus)
            members.append(member)
    except Exception:
        for member in members:
            member.shutdown()
        raise
    if len(members) == 1:
        return members[0]
    return BusGroup(members, names)
