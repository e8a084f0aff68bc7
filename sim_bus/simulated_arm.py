"""The simulated arm: plant, sensors, and one drive per joint: a CANopen node, or a drive of another family."""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.bus.port import BUS_SHIFT
from armlink.drives.canopen.cia402 import DriveState
from armlink.drives.canopen.object_dictionary import SYNC_ID
from armlink.errors import BadInput
from sim_bus.drives.fronts import build_fronts
from sim_bus.drives.motor import Motor, Readings
from sim_bus.drives.simulated_drive import SimulatedDrive
from sim_bus.effects.effect import EffectSetting
from sim_bus.effects.realism import add_realism
from sim_bus.effects.registry import imperfections
from sim_bus.effects.state import Imperfections
from sim_bus.node.devices import device_of, power_on_values
from sim_bus.node.drives import APPLIED, SimulatedDrives
from sim_bus.node.node import Node
from sim_bus.node.object_arrays import Key, ObjectArrays
from sim_bus.node.pdo import Frame, MappedPdo, PdoTable
from sim_bus.node.supervision import RESET_NODE, Supervision
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import JointSensors
from sim_bus.sim_section import sim_section
from sim_bus.truth import Truth

DRIVE_ERROR = 0x21
"""Error register: generic and device profile."""
WARMING_STEP = 1.0
"""Torque constants of drives that warm up are brought up to date so often [s]."""
TARGETS = {(0x6071, 0), (0x607A, 0), (0x60FF, 0)}

UNTAGGED = (1 << BUS_SHIFT) - 1
SERVICE = 0x780
"""Bits of an identifier that are CANopen's function code; the others are bus and node."""


class SimulatedArm:
    """Takes frames by on_frame(), sends to `outbox`, advances by advance(). Deterministic for truth and seed.

    Where it stands on several buses, identifiers carry the number of theirs, as those of a host's port do.
    """

    def __init__(self, arm: ArmFile, truth: Truth, seed: int = 0) -> None:
        """Power on: every node boots. Raises BadInput if the arm file is insufficient for simulation."""
        section, link = sim_section(arm), arm.require_link()
        self.arm, self.truth, self.names, self.n = arm, truth, arm.joint_names, len(arm.joint_names)
        self.time = 0.0
        self._seed, self._warmed = seed, 0.0
        self.outbox: deque[Frame] = deque()
        self.default_period = self._period = 1.0 / link.rate
        self._entries: tuple[EffectSetting, ...] = section.effects
        with self._effects_checked():
            state = self._imperfections()
            self.plant = Plant(arm, state)
        self.sensors = JointSensors(arm, truth, state, seed)
        self._signals = ObjectArrays(self.n)
        self.drives = SimulatedDrives(arm, self.plant, self.sensors, self._signals)
        self._sampled = 0.0
        self._synchronous = self._watching = False
        self.nodes = [
            Node(j, joint.settings.node, self._signals, self._send)
            for j, joint in enumerate(link.joints)
            if joint.settings.family == "canopen"
        ]
        self._node_at = {node.place: node for node in self.nodes}
        self._tags: dict[str, int] = {}
        """Name of each bus → what identifiers on it have in addition; empty: all joints are on one bus."""
        self._address()
        self.supervision = Supervision(self.nodes, self.drives, self._apply)
        self._operational = self.supervision.operational
        self._pdos = PdoTable(self._signals, self._operational, self._send)
        for node in self.nodes:
            joint = link.joints[node.place]
            node.device = device_of(joint, section.device)
            node.identity = power_on_values(arm, joint, int(self.sensors.increments[node.place]), node.device)
            node.reset()
            node.on_write = lambda key, node=node: self._written(node, key)  # type: ignore[misc]
            node.on_pdo_change = self._compile
            self._apply(node)
        self._compile()
        self.drives.set_devices([node.device for node in self.nodes], [node.place for node in self.nodes])
        self.drives.on_state = self._state_changed
        self.drives.on_fault = lambda joint, code: self._node_at[joint].emergency(code, DRIVE_ERROR)
        self.drives.take_commands()
        self.drives.sample(0.0, 0.0)
        self._readings = readings = Readings(self.plant, self.sensors)
        motors = [Motor(j, joint, self.drives.loops, self.sensors, readings) for j, joint in enumerate(link.joints)]
        self.fronts = build_fronts(arm, motors, self._sender)
        """Bus and drives of every family but CANopen."""
        self.drive_at = {drive.joint: drive for _, front in self.fronts for drive in front.drives}
        self.plant.averages = bool(self.drive_at)
        self._set_torque_constants()
        for drive in self.drive_at.values():
            drive.pass_time(0.0)

    # ---- bus

    def stand_on(self, buses: Sequence[str]) -> None:
        """Stand on several buses, by name in the arm file's order, on which ids may repeat; nodes boot there."""
        self._tags = {name: place << BUS_SHIFT for place, name in enumerate(buses)}
        self.outbox.clear()
        for node in self.nodes:
            node.tag = self._tags[self.arm.require_link().joints[node.place].bus]
            node.boot_up()
        self._address()
        self._compile()

    def on_frame(self, can_id: int, data: bytes) -> None:
        """Process a frame: SYNC samples and applies targets; PDO, SDO, NMT and heartbeat by CiA 301."""
        pdo = self._pdos.receive.get(can_id)
        if pdo is not None:
            self._receive_pdo(pdo, data)
        elif can_id in self._sdo:
            if self.time > self._sampled:
                self._sample()
            self._sdo[can_id].on_sdo(data)
            self.drives.take_commands()
            self._pdos.send_events()
        else:
            self._to_all(can_id & UNTAGGED, can_id & ~UNTAGGED, data)
        for bus, front in self.fronts:
            if self._tags.get(bus, 0) == can_id & ~UNTAGGED:
                front.on_frame(can_id & UNTAGGED, data)

    def _to_all(self, can_id: int, tag: int, data: bytes) -> None:
        """Process a frame that may be to all CANopen nodes on the bus of that tag."""
        if can_id == SYNC_ID:
            self._sync()
        elif can_id == 0:
            self.supervision.frame(data, tag)
            self._pdos.send_events()
        elif 0x700 < can_id < 0x780 and data:
            self.supervision.heartbeat(can_id - 0x700, self.time, tag)

    def waits_for_sync(self, can_id: int) -> bool:
        """Whether a frame takes effect at the next SYNC only: a synchronous RPDO."""
        pdo = self._pdos.receive.get(can_id)
        return pdo is not None and pdo.kind <= 240

    def advance(self, duration: float) -> None:
        """Advance simulated time [s], in equal steps of about a SYNC period, or less.

        A cycle that is a little late is one step: a short one after it would sample the torque at another phase.
        """
        remaining = duration
        piece = duration / max(1, round(duration / self._longest_step))
        while remaining > 1e-9:
            for drive in self.drive_at.values():
                drive.control(piece)
            self.drives.loops.advance(piece, self._synchronous)
            if self.drive_at:
                self._readings.step_ends()
            self._synchronous = False
            self.time += piece
            remaining -= piece
            for drive in self.drive_at.values():
                drive.pass_time(self.time)
            if self.supervision.due <= self.time:
                self.supervision.check(self.time)
            if self._watching:
                self.drives.watch()
            if self.sensors.warms and self.time >= self._warmed + WARMING_STEP:
                self._set_torque_constants()
            if remaining > 1e-9:
                self._sample()
            self._pdos.send_events()

    def reboot(self, joint: int) -> None:
        """Power-cycle one joint's controller: volatile settings are lost."""
        if joint in self._node_at:
            self.supervision.command(self._node_at[joint], RESET_NODE)
        else:
            self.drive_at[joint].reboot()

    def device(self, joint: int) -> Node | SimulatedDrive:
        """The device of a joint on the bus: its CANopen node, or its drive of another family."""
        return self._node_at.get(joint) or self.drive_at[joint]

    def joint_of(self, can_id: int) -> int | None:
        """Joint whose device sends frames of this identifier, or None."""
        untagged, tag = can_id & UNTAGGED, can_id & ~UNTAGGED
        if untagged >= 0x80 and (place := self.node_place(can_id)) is not None:
            return place
        fronts = [front for bus, front in self.fronts if self._tags.get(bus, 0) == tag]
        return next((joint for front in fronts if (joint := front.joint_of(untagged)) is not None), None)

    def node_place(self, can_id: int) -> int | None:
        """Joint whose CANopen node an identifier of its bus names by its last seven bits, or None."""
        return self._place_of.get(can_id & ~SERVICE) if can_id & UNTAGGED < 0x800 else None

    @property
    def due(self) -> float:
        """When a device next acts by itself [s]."""
        return min([self.supervision.due, *(drive.due for drive in self.drive_at.values())])

    def postpone(self, seconds: float) -> None:
        """Postpone all deadlines for the host [s], because the simulated arm itself was late."""
        self.supervision.postpone(seconds)
        for drive in self.drive_at.values():
            drive.postpone(seconds)

    @property
    def period(self) -> float:
        """SYNC period: 1006h if set, else from the arm file's rate [s]."""
        return self._period

    @property
    def operational(self) -> bool:
        """Whether any node is operational and thus reacts to SYNC."""
        return any(self._operational)

    @property
    def _longest_step(self) -> float:
        """A SYNC period, or the shorter one of a drive that sends several times a cycle to a slow host [s]."""
        return min([self.period, *(drive.own_period for drive in self.drive_at.values())])

    # ---- truth, hidden from any fit

    def gravity_torque(self, q: Array) -> Array:
        """True holding torque at the true angles `q` (K, n) → (K, n) [N·m], by MuJoCo."""
        return self.plant.gravity_torque(q)

    def attach_mass(self, mass: float, point: Array | None = None) -> None:
        """Attach `mass` [kg] at `point` of the last bar frame [m], by default at the true attachment."""
        self.plant.attach_mass(mass, self.truth.attachment if point is None else point)

    def detach_mass(self) -> None:
        self.plant.detach_mass()

    def turn_by_hand(self, joint: int | str, angle: float) -> None:
        """Put a joint at the true angle [rad], kept within its stops, as a person does while it has no power."""
        self.plant.place(self._place(joint), angle)
        self._sample()

    def drift(self, joint: int | str, gain: float, offset: float) -> None:
        """Change a torque sensor from now on: multiply its gain by `gain`, add `offset` [N·m]."""
        self.sensors.drift(self._place(joint), gain, offset)
        self._set_torque_constants()

    def set_effects(self, entries: Iterable[EffectSetting]) -> None:
        """Replace the arm's imperfections while it runs. Raises BadInput."""
        before, self._entries = self._entries, tuple(entries)
        try:
            with self._effects_checked():
                state = self._imperfections()
                self.plant.set_imperfections(state)
        except BadInput:
            self._entries = before
            raise
        self.sensors.set_imperfections(state)
        self.drives.loops.reconfigure()
        self._set_torque_constants()

    @property
    def effects(self) -> tuple[EffectSetting, ...]:
        return self._entries

    @property
    def true_sensors(self) -> Truth:
        """True sensor parameters at present, drifts and effects included."""
        sensors, truth = self.sensors, self.truth
        return Truth(
            sensors.gain_at(self.time),
            sensors.offset + sensors.cold_zero(self.time),
            sensors.position_gain,
            sensors.position_offset,
            attachment=truth.attachment,
        )

    @property
    def true_friction(self) -> Array:
        """True Coulomb friction (n,) [N·m], of the mean over position and both directions."""
        return self._imperfections().coulomb

    # ---- internals

    def _set_torque_constants(self) -> None:
        """A drive without a torque sensor makes as much torque too little as its reading is too large."""
        current = np.zeros(self.n, bool)
        current[list(self.drive_at)] = True
        self._warmed = self.time
        self.plant.torque_constant = np.where(current, self.sensors.gain_at(self.time), 1.0)
        self.drives.loops.imagined = np.where(current, self.sensors.offset, 0.0)
        self.drives.loops.reconfigure()

    def _sender(self, bus: str) -> Callable[[int, bytes], None]:
        return lambda can_id, data: self.outbox.append((can_id | self._tags.get(bus, 0), data))

    def _send(self, frame: Frame) -> None:
        self.outbox.append(frame)

    def _address(self) -> None:
        self._place_of = {node.tag | node.node_id: node.place for node in self.nodes}
        self._sdo = {node.tag | 0x600 + node.node_id: node for node in self.nodes}

    def _imperfections(self) -> Imperfections:
        """Current effects and the arm file's realism as one state."""
        state, realism = imperfections(self.names, self._entries), sim_section(self.arm).realism
        rated = self.arm.require_link().rated_torques
        add_realism(state, rated, realism.level, realism.seed)
        drives = sim_section(self.arm).quasi_direct
        if drives is not None:
            drives.add_to(state, rated, self._seed)
        return state

    @contextmanager
    def _effects_checked(self) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise BadInput(f"{self.arm.path}: sim.effects: {error}") from None

    def _place(self, joint: int | str) -> int:
        if isinstance(joint, int):
            return joint
        if joint not in self.names:
            raise BadInput(f"there is no joint {joint!r}; expected one of {', '.join(self.names)}")
        return self.names.index(joint)

    def _receive_pdo(self, pdo: MappedPdo, data: bytes) -> None:
        size = pdo.packed.itemsize
        if not self._operational[pdo.node]:
            return
        if len(data) < size:
            self._node_at[pdo.node].emergency(0x8210, 0x10, struct.pack("<BB", len(data), size))
            return
        pdo.content = data[:size]
        if self.supervision.watches_rpdos:
            self.supervision.rpdo(pdo.node, pdo.number, self.time)
        if pdo.kind > 240:
            self._take((pdo,))
            self._pdos.send_events()

    def _sync(self) -> None:
        if not any(self._operational):
            self._synchronous = False
            return
        self._sample()
        self._pdos.send_sync()
        self._take(self._pdos.sync_receive)
        self._pdos.send_events()
        self._synchronous = True
        self.supervision.sync(self.time)

    def _take(self, pdos: Sequence[MappedPdo]) -> None:
        taken = [pdo for pdo in pdos if pdo.take()]
        if taken:
            self.drives.take_commands()
        for index, sub in TARGETS:
            if rows := [pdo.node for pdo in taken if (index, sub) in pdo.keys]:
                self.drives.loops.fresh(index, rows)

    def _state_changed(self, joint: int) -> None:
        node = self._node_at[joint]
        if node.errors and self.drives.state[joint] is DriveState.SWITCH_ON_DISABLED:
            node.emergency(0, 0)
        self._watching = self.drives.needs_watch

    def _sample(self) -> None:
        self.drives.sample(self.time, self.time - self._sampled)
        self._sampled = self.time

    def _written(self, node: Node, key: Key) -> None:
        if key in TARGETS:
            self.drives.loops.fresh(key[0], [node.place])
        elif key[0] < 0x6000 or key[0] in APPLIED:
            self._apply(node)

    def _apply(self, node: Node) -> None:
        self.drives.bring_into_force(node)
        self._watching = self.drives.needs_watch
        self.supervision.configure(node, self.time)
        given = self.nodes[0].value(0x1006)
        self._period = given * 1e-6 if given else self.default_period

    def _compile(self) -> None:
        self._pdos.compile(
            [pdo for node in self.nodes for pdo in node.pdos(receive=True)],
            [pdo for node in self.nodes for pdo in node.pdos(receive=False)],
        )
