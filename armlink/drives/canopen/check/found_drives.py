"""Drives on a bus that no arm file describes yet: ratings, scales and positions, read by SDO; nothing is written."""

from armlink.bus.can_bus import CanBus
from armlink.clock import MonotonicClock
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen.check.scan import reading_network, scan_bus
from armlink.drives.canopen.controller_setup import Identity
from armlink.drives.canopen.eds_file import bundled
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.units import units_from
from armlink.drives.findings import FoundDrive
from armlink.errors import BusFault


class FoundNodes:
    """The drives of an open bus, by node id."""

    def __init__(self, bus: CanBus) -> None:
        """Search the bus and read every drive; raises BusFault naming the node."""
        port, clock = bus.open_port(), bus.clock or MonotonicClock()
        identities = scan_bus(port, clock, {})
        twins = [str(each.node) for each in identities if each.answers > 1]
        if twins:
            raise BusFault(f"{bus.channel_info}: node id {', '.join(twins)} answers twice: give every node its own id")
        network, pump = reading_network(port, clock)
        self._services = {
            each.node: NodeServices(network, f"node {each.node}", each.node, bundled(), pump) for each in identities
        }
        self.identities = {each.node: each for each in identities}
        """By node id."""
        self.found = [self._read(each) for each in identities]

    def positions(self) -> dict[int, float]:
        """Position reading (6064h) of every drive by node id [rad]; raises BusFault."""
        return {each.node: int(self._services[each.node].read(objects.POSITION)) * each.unit for each in self.found}

    def _read(self, identity: Identity) -> FoundDrive:
        read = self._services[identity.node].read
        rated = int(read(objects.RATED_TORQUE))
        try:
            units = units_from(
                rated,
                (int(read(objects.ENCODER_INCREMENTS)), int(read(objects.ENCODER_REVOLUTIONS))),
                (int(read(objects.GEAR_MOTOR)), int(read(objects.GEAR_SHAFT))),
                (int(read(objects.FEED)), int(read(objects.FEED_SHAFT))),
            )
        except ValueError as error:
            raise BusFault(f"node {identity.node}: no units: {error}: set up the drive first") from None
        most = int(read(objects.MAX_TORQUE)) * units.torque
        own = self._services[identity.node].has(objects.TORQUE_READING)
        keys = {"family": "canopen", "node": identity.node, "torque": "motor", "calibration": "host"}
        ratings = rated * 1e-3, most, units.position
        return FoundDrive(identity.node, identity.vendor, identity.product, *ratings, None if own else keys)
