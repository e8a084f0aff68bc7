"""Rules of a bus guard for CiA 402 drives: frames of the cycle within limits, and the writes of the set-up."""

import math
from collections.abc import Sequence
from typing import Any

from armlink.arm_file import LinkJoint
from armlink.drives.canopen import controller_setup as device
from armlink.drives.canopen import object_dictionary as objects
from armlink.drives.canopen import pdo
from armlink.drives.canopen.cia402 import Control
from armlink.drives.canopen.cyclic.wire import UINT32_MAX, check_fits
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import Pdo
from armlink.drives.canopen.profile import Profile
from armlink.drives.canopen.sdo import NodeServices
from armlink.drives.canopen.units import Units, read_units
from armlink.drives.orders import Limits, Mode
from armlink.errors import BadInput
from armlink.torque_calibration import GAIN_RANGE, MOST_OFFSET

BURST = 5
"""Cycles whose change may come at once, after the host was late."""
SYNCS_A_CYCLE = 2
"""Every drive acts on a SYNC at once; a cycle may follow another early, when the host was late."""
READING_AGE = 5.0
"""A reading stands for where a joint is for this long [s]; its set-up takes some seconds before the first cycle."""
_NMT_COMMANDS = (1, 2, 128, 129, 130)
_ACKNOWLEDGED = 0x60
_UPLOADED = {1: 0x4F, 2: 0x4B, 4: 0x43}
"""First byte of the answer to an SDO read, by the size of the value (CiA 301, 7.2.4.3.6)."""
_WRITE_2_BYTES = 0x2B
POWER_BITS = 0x0F
"""Bits of the control word that give power: an enabled drive stays so whatever bit 7 says, which resets faults alone
(CiA 402-2)."""
ROUNDING = 1
"""A target that follows a reading is this far from it at most [counts]."""


def guard_rules(
    rows: Sequence[LinkJoint], services: Sequence[NodeServices], limits: Sequence[Limits], protection: device.Protection
) -> dict[str, Any]:
    """Rules of the joints with scales and objects as their devices tell them; raises BadInput, BusFault."""
    nodes = tuple(row.settings.node for row in rows)
    shared = shared_rules(nodes, protection.host, limits[0].period)
    rules: dict[str, Any] = {"frames": shared, "stop": [], "restarts": {}}
    for row, each, limit in zip(rows, services, limits, strict=True):
        device.check_identity(each, row)
        unit, profile = read_units(each, row), device.examine_device(each, row.settings)
        if profile.by_velocity:
            raise BadInput(
                f"{row.name}: its drive takes only velocities (mode 9), which do not show a guard where the joint "
                "will stop: a guard needs drives with cyclic position (8) or torque (10) mode"
            )
        check_fits(row, limit, unit)
        sheet = list(each.remote.object_dictionary)
        node = NodeRules(row.name, row.settings.node, profile, unit, limit, protection, sheet)
        rules["frames"] |= node.frames()
        rules["stop"].append(node.stop)
        boot_up, answers = node.restart
        rules["restarts"][f"{boot_up}"] = answers
    return rules


def shared_rules(nodes: tuple[int, ...], host: int, period: float) -> dict[str, Any]:
    """Frames to all drives: NMT to these nodes, SYNC once in a cycle of `period` [s], the host's heartbeat."""
    return {
        f"{objects.NMT_ID}": {
            "lengths": [2],
            "fields": [
                {"name": "NMT command", "at": 0, "code": "B", "values": list(_NMT_COMMANDS)},
                {"name": "node", "at": 1, "code": "B", "values": [0, *nodes]},
            ],
        },
        f"{objects.SYNC_ID}": {"lengths": [0], "per_second": SYNCS_A_CYCLE / period, "burst": BURST},
        f"{objects.HEARTBEAT_ID + host}": {
            "lengths": [1],
            "fields": [{"name": "state of the host", "at": 0, "code": "B", "values": [objects.OPERATIONAL]}],
        },
    }


class NodeRules:
    def __init__(
        self,
        name: str,
        node: int,
        profile: Profile,
        unit: Units,
        limits: Limits,
        protection: device.Protection,
        described: list[int],
    ) -> None:
        """`unit` and `profile` as the device tells them, `described` the indices of its data sheet."""
        self.name, self.node, self.profile, self.unit, self.limits = name, node, profile, unit, limits
        self._protection, self._described = protection, described

    @property
    def stop(self) -> tuple[int, str]:
        """The SDO write that quick-stops it, at once and without SYNC."""
        request = bytes([_WRITE_2_BYTES]) + objects.CONTROL_WORD.address + bytes([Control.QUICK_STOP, 0, 0, 0])
        return objects.SDO_REQUEST_ID + self.node, request.hex()

    @property
    def restart(self) -> tuple[int, int]:
        """Identifier of its boot-up message, and of its SDO answers, which count no more after one."""
        return objects.HEARTBEAT_ID + self.node, self._answers

    @property
    def _answers(self) -> int:
        return objects.SDO_RESPONSE_ID + self.node

    def frames(self) -> dict[str, Any]:
        """RPDO1, RPDO2 and SDO requests."""
        rules: dict[str, Any] = {f"{objects.SDO_REQUEST_ID + self.node}": {"sdo": self._writes()}}
        written = [bytes([_ACKNOWLEDGED]) + entry.address for each in self.profile.pdos for entry in _mapping(each)]
        after = [[self._answers, answer.hex()] for answer in written]
        for each in self.profile.pdos:
            if each.name not in (pdo.RPDO1.name, pdo.RPDO2.name):
                continue
            fields = [
                field
                for entry, at in _places(each)
                if (field := self._target(entry)) is not None and not field.update(at=at)
            ]
            rule = {"lengths": [each.layout.size], "fields": fields, "after": after}
            power = [at for entry, at in _places(each) if entry == objects.CONTROL_WORD]
            if power:
                code = objects.CONTROL_WORD.code
                rule["power"] = {"at": power[0], "code": code, "mask": POWER_BITS, "value": int(Control.ENABLE)}
            rules[f"{each.cob_base + self.node}"] = rule
        return rules

    def _target(self, entry: Entry) -> dict[str, Any] | None:
        """Bounds of one target; None for an object that commands no motion by itself."""
        limits, period = self.limits, self.limits.period
        if entry == objects.MODE:
            return {"name": f"mode of {self.name}", "code": entry.code, "values": [int(mode) for mode in Mode]}
        if entry == objects.TARGET_TORQUE:
            step, reading = limits.torque_rate / self.unit.torque, objects.MOTOR_TORQUE
            most = math.floor(limits.max_torque / self.unit.torque + 1e-9)
            bounds, what = (-most, most), "torque"
        elif entry == objects.TARGET_POSITION:
            step, reading = limits.max_velocity / self.unit.position, objects.POSITION
            bounds = math.ceil(limits.lower / self.unit.position), math.floor(limits.upper / self.unit.position)
            what = "position"
        else:
            return None
        return {
            "name": f"target {what} of {self.name}",
            "code": entry.code,
            "least": bounds[0],
            "most": bounds[1],
            "rate": step,
            "slack": BURST * step * period + 2,
            "near": self._readings(reading),
            "within": ROUNDING,
            "age": READING_AGE,
            "first": [0] if entry == objects.TARGET_TORQUE else [],
            "leads_back": entry == objects.TARGET_POSITION,
        }

    def _readings(self, entry: Entry) -> list[dict[str, Any]]:
        """Where an object is read: in TPDOs, and in answers to SDO reads."""
        answer = bytes([_UPLOADED[entry.bits // 8]]) + entry.address
        found = [{"frame": self._answers, "prefix": answer.hex(), "at": 4, "code": entry.code}]
        for each in self.profile.pdos:
            if each.communication >= 0x1800:
                cob_id = each.cob_base + self.node
                found += [{"frame": cob_id, "at": at, "code": entry.code} for e, at in _places(each) if e == entry]
        return found

    def _writes(self) -> dict[str, Any]:
        """Objects that may be written, with the values that the set-up gives them."""
        allowed: dict[Entry, dict[str, Any]] = {}
        for index in pdo.foreign_rpdos(self._described):
            allowed[Entry(index, 1, "I", "COB-ID of an RPDO that is off")] = {"least": pdo.INVALID, "most": UINT32_MAX}
        for each in self.profile.pdos:
            is_command = each.communication == pdo.RPDO1.communication
            watched = is_command and self.profile.has(objects.RPDO_DEADLINE)
            for deadline in {self._protection.deadline_ms if watched else 0, None}:
                for entry, value in pdo.mapping_writes(each, self.node, deadline):
                    values = allowed.setdefault(entry, {"values": []})["values"]
                    if value not in values:
                        values.append(value)
        allowed[objects.TORQUE_OFFSET] = {"values": [0]}
        allowed[objects.MODE] = {"values": [int(mode) for mode in Mode]}
        every_mode = UINT32_MAX
        for entry, value in device.settings(self.unit, self.limits, self._protection, every_mode, self.profile):
            allowed[entry] = {"values": [value]}
        if self.profile.reading == objects.TORQUE_READING:
            allowed |= _record_writes()
        return {
            f"{entry.index:X}:{entry.sub:X}": {"name": f"{entry} of {self.name}", "code": entry.code, **bounds}
            for entry, bounds in allowed.items()
        }


def _record_writes() -> dict[Entry, dict[str, Any]]:
    """The torque sensor record: its values bounded, since a wrong gain would change every torque that is read."""
    free = {"least": 0, "most": UINT32_MAX}
    return {
        objects.STAGED_GAIN: {"least": GAIN_RANGE[0], "most": GAIN_RANGE[1]},
        objects.STAGED_OFFSET: {"least": -MOST_OFFSET, "most": MOST_OFFSET},
        objects.RECORD_ID: free,
        objects.RECORD_DATE: free,
        objects.RECORD_CRC: free,
        objects.ACTIVATE: {"values": [1]},
        objects.STORE_MANUFACTURER: {"values": [objects.STORE_SIGNATURE]},
    }


def _places(each: Pdo) -> list[tuple[Entry, int]]:
    """The objects of a PDO and where they begin."""
    places, at = [], 0
    for entry in each.entries:
        places.append((entry, at))
        at += entry.bits // 8
    return places


def _mapping(each: Pdo) -> list[Entry]:
    """The objects that make a PDO what it is: each mapped object, their number, the identifier."""
    count, cob_id = Entry(each.mapping, 0, "B", "number"), Entry(each.communication, 1, "I", "COB-ID")
    return [Entry(each.mapping, i, "I", "mapping") for i in range(1, len(each.entries) + 1)] + [count, cob_id]
