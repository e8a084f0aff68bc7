"""Scan of a bus: which nodes are present, their identity and state; reads only."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

from armlink.bus.port import Port
from armlink.clock import Clock
from armlink.drives.canopen.controller_setup import Identity, identify
from armlink.drives.canopen.eds_file import bundled
from armlink.drives.canopen.object_dictionary import SDO_REQUEST_ID
from armlink.drives.canopen.profile import Profile, lacking
from armlink.drives.canopen.sdo import NodeServices, Pump, PumpedNetwork

SEARCH_SECONDS = 0.3
"""Wait for responses after the last request of the search [s]."""
_READ_DEVICE_TYPE = b"\x40\x00\x10\x00\x00\x00\x00\x00"


def reading_network(port: Port, clock: Clock) -> tuple[PumpedNetwork, Pump]:
    """A network for SDO reads over a port, and the function that waits for their answers."""
    network = PumpedNetwork(port.send)

    def pump(done: Callable[[], bool], timeout: float) -> bool:
        end = clock.now() + timeout
        while not done():
            frame = port.receive(max(0.0, end - clock.now()))
            if frame is None or clock.now() > end + SEARCH_SECONDS:  # a babbling node must not block the search
                return False
            network.notify(frame[0], bytearray(frame[1]), 0.0)
        return True

    return network, pump


def scan_bus(port: Port, clock: Clock, joints: Mapping[int, str], stock: Collection[int] = ()) -> list[Identity]:
    """Every node that answers a read of its device type, and the nodes of `joints` (node id → joint name) that do not.

    Nodes of `stock` are asked for the optional objects of the profile, too. Sorted by node id. Raises BusFault if one
    that answered stops answering.
    """
    network, pump = reading_network(port, clock)
    found = _search(port, pump, network)
    dictionary = bundled()
    identities = []
    for node in sorted({*+found, *joints}):
        name = joints.get(node, "")
        if found[node] > 1:  # both nodes would answer every request
            identities.append(Identity(name, node, present=True, answers=found[node]))
        elif found[node]:
            services = NodeServices(network, name, node, dictionary, pump)
            lost = Profile(absent=lacking(services)).lost if node in stock else ()
            identities.append(replace(identify(services), lost=lost))
        else:
            identities.append(Identity(name, node, present=False))
    return identities


def _search(port: Port, pump: Pump, network: PumpedNetwork) -> Counter[int]:
    """Node id → number of responses to one request."""
    found: Counter[int] = Counter()

    def answered(can_id: int, data: bytearray, timestamp: float) -> None:
        found[can_id - 0x580] += bytes(data[1:4]) == _READ_DEVICE_TYPE[1:4]

    for node in range(1, 128):
        network.subscribe(0x580 + node, answered)
        port.send(SDO_REQUEST_ID + node, _READ_DEVICE_TYPE)
        pump(lambda: False, 0.0)
    pump(lambda: False, SEARCH_SECONDS)
    for node in range(1, 128):
        network.unsubscribe(0x580 + node, answered)
    return found


def describe_type(device_type: int) -> str:
    """Device profile of 1000h as text, for example `CiA 402 servo drive`."""
    profile = device_type & 0xFFFF
    kind = {0x0001: "frequency converter", 0x0002: "servo drive", 0x0004: "stepper"}.get(device_type >> 16 & 0xFF, "")
    return f"CiA {profile} {kind}".strip() if profile else "no profile"
