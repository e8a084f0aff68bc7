"""Buses by name: `INTERFACE:CHANNEL[@BITRATE]`, any interface that python-can knows."""

from typing import TYPE_CHECKING, Any

from armlink.armfile import Bus
from armlink.errors import BadInput, BusFault

if TYPE_CHECKING:
    import can

FORM = "INTERFACE:CHANNEL[@BITRATE], for example socketcan:can0 or socketcan:can0@1000000"


def parse_bus(spec: str, default_bitrate: int = 1_000_000) -> Bus:
    """Take a bus specification apart; raises BadInput with the form that was expected."""
    interface, colon, rest = spec.partition(":")
    channel, at, bitrate = rest.partition("@")
    if not (interface and colon and channel):
        raise BadInput(f"bus {spec!r}: expected {FORM}")
    if at and not (bitrate.isdigit() and int(bitrate) > 0):
        raise BadInput(f"bus {spec!r}: bit rate {bitrate!r}, expected a number of bits a second: {FORM}")
    return Bus(interface=interface, channel=channel, bitrate=int(bitrate) if at else default_bitrate)


def resolve_bus(spec: str | None, section: Bus) -> Bus:
    """The bus that the command line names, else the arm file's."""
    return section if spec is None else parse_bus(spec, section.bitrate)


def open_bus(spec: str | None, section: Bus) -> "can.BusABC":
    """Open the bus that `spec` names, or else the arm file's section.

    Raises BadInput for a malformed specification or an interface that python-can does not know, and BusFault where
    the bus does not exist or cannot be opened.
    """
    import can
    from can.exceptions import CanInterfaceNotImplementedError

    bus = resolve_bus(spec, section)
    name = f"{bus.interface}:{bus.channel}"
    options: dict[str, Any] = {} if bus.interface == "socketcan" else {"bitrate": bus.bitrate}
    try:
        return can.Bus(interface=bus.interface, channel=bus.channel, **options)
    except CanInterfaceNotImplementedError as error:
        raise BadInput(f"bus {name}: {error}: python-can has no such interface here") from None
    except (can.CanError, OSError, ValueError, ImportError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BusFault(f"bus {name}: cannot open it: {reason}") from None
