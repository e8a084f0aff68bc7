"""Settings of a joint controller: power-on values, and how written objects take effect in the drive."""

from zlib import crc32

import numpy as np

from armlink.arm_file import ArmFile, LinkJoint
from armlink.drives.canopen.eds_file import expected_identity, of_joints
from sim_bus.node.devices import Device
from sim_bus.node.drives import SUPPORTED_MODES, UNWATCHED, SimulatedDrives
from sim_bus.node.node import Node
from sim_bus.node.object_arrays import Key
from sim_bus.node.position_torque_loops import FEED, UNIT
from sim_bus.sim_section import sim_section

APPLIED = (0x6007, 0x605A, 0x6065, 0x607D, 0x6085, 0x60C2)
"""Objects of the drive profile that take effect when written."""

IDENTITY = ("vendor", "product", "revision", "serial")
"""Keys of a joint's identity in the arm file, in the order of 1018h's sub-indices."""
TEMPERATURE = 310
"""Temperature of every drive [0.1 °C]."""


def power_on_values(arm: ArmFile, joint: LinkJoint, increments: int, device: Device) -> dict[Key, int | str]:
    """Objects of one joint that differ from the EDS's defaults; `increments` of the encoder per joint revolution."""
    link, servo = arm.require_link(), sim_section(arm).servo
    stated = expected_identity(joint, of_joints(arm, [joint])[0]).model_dump(exclude_none=True)
    deceleration = round(servo.quick_stop_deceleration / UNIT)
    return {
        (0x1018, 4): crc32(f"{arm.name} {arm.serial} {joint.name}".encode()),
        (0x2101, 0): TEMPERATURE,
        (0x6072, 0): min(round(joint.max_torque * 1000 / joint.rated_torque), 0xFFFF),
        (0x6076, 0): round(joint.rated_torque * 1000),
        (0x6081, 0): round(joint.max_velocity / UNIT),
        (0x6083, 0): deceleration,
        (0x6085, 0): deceleration,
        (0x6087, 0): round(joint.max_torque_rate * 1000 / joint.rated_torque),
        (0x608F, 1): increments,
        (0x6092, 1): FEED,
        (0x60C2, 1): min(max(round(1000 / link.rate), 1), 255),
        (0x6502, 0): _modes_shown(device),
        **device.values,
        **{(0x1018, sub): stated[key] for sub, key in enumerate(IDENTITY, start=1) if key in stated},
    }


def _modes_shown(device: Device) -> int:
    has = SUPPORTED_MODES if device.modes is None else sum(1 << (mode - 1) for mode in device.modes)
    return has & ~device.hidden_modes


def bring_into_force(node: Node, drives: SimulatedDrives) -> None:
    """Apply the node's calibration record and drive settings to its drive."""
    joint, record, loops, window = node.place, node.record.active, drives.loops, node.value(0x6065)
    drives.gain[joint], drives.offset[joint] = record.gain, record.offset
    drives.quick_stop_option[joint] = node.value(0x605A)
    drives.following_window[joint] = np.inf if window == UNWATCHED else window * UNIT
    loops.deceleration[joint] = max(node.value(0x6085), 1) * UNIT
    loops.interpolate(joint, node.value(0x60C2, 1) * 10.0 ** node.value(0x60C2, 2))
    loops.lowest[joint], loops.highest[joint] = node.value(0x607D, 1), node.value(0x607D, 2)
