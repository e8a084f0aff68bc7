"""Electronic data sheets (EDS, CiA 306) of joint controllers: named in the arm file, by default the bundled one."""

import functools
import re
from collections.abc import Iterable, Sequence
from importlib.resources import files
from io import StringIO
from pathlib import Path
from typing import Any

import canopen
from canopen.objectdictionary.eds import import_eds

from armlink.arm_file import ArmFile, DeviceIdentity, LinkJoint
from armlink.content.file_content import read_whole
from armlink.drives.canopen import object_dictionary
from armlink.drives.canopen.object_dictionary import Entry
from armlink.drives.canopen.pdo import LINK_PDOS
from armlink.errors import BadInput

SUFFIXES = (".eds", ".dcf")
MOST_ENTRIES = 254
"""Largest sub-index of an array (CiA 301: 255 has another use)."""
OPTIONAL = {
    object_dictionary.TORQUE_OFFSET: "torque offset: the device has none, so nothing has to be cleared",
    object_dictionary.PROFILE_VELOCITY: "profile velocity: the device has no profile position mode",
    object_dictionary.TORQUE_SLOPE: "torque slope: the device has no profile torque mode",
    object_dictionary.STORE_MANUFACTURER: "store: the device loses its calibration at power-off",
    object_dictionary.HEARTBEAT_PRODUCER: "",
}
"""Objects that a controller may lack → the function that is then missing."""
_STOCK = (
    object_dictionary.RPDO_DEADLINE,
    object_dictionary.TARGET_VELOCITY,
    object_dictionary.POSITION_SI_UNIT,
    object_dictionary.VELOCITY_SI_UNIT,
    object_dictionary.INTERPOLATION_VALUE,
    object_dictionary.INTERPOLATION_INDEX,
)
"""Objects that only stock devices are asked for, or that are not in every data sheet."""


def used_objects() -> Iterable[Entry]:
    """The objects of a controller with our torque sensor record that the link uses."""
    return [value for value in vars(object_dictionary).values() if isinstance(value, Entry) and value not in _STOCK]


def bundled_path() -> str:
    return str(files("armlink.drives.canopen").joinpath("eds/joint.eds"))


@functools.cache
def bundled() -> Any:
    """Object dictionary of a joint controller from the bundled data sheet, for node 1; read once, nobody changes it."""
    return canopen.import_od(bundled_path(), 1)


def of_joints(arm: ArmFile, joints: Sequence[LinkJoint]) -> tuple[Any, ...]:
    """Object dictionary of each joint's controller; raises BadInput as read_sheet."""
    read = dict[str | None, Any]()
    for joint in joints:
        if joint.eds not in read:
            read[joint.eds] = bundled() if joint.eds is None else read_sheet(arm.path.parent / joint.eds, joint)
    return tuple(read[joint.eds] for joint in joints)


def read_sheet(path: Path, joint: LinkJoint) -> Any:
    """Object dictionary that a joint's own data sheet describes.

    Raises BadInput if the file cannot be read, or if an object that the link uses is missing, has another length, or
    cannot be mapped into the PDO in which the link needs it.
    """
    where = f"{joint.name}: data sheet {path}"
    if path.suffix.lower() not in SUFFIXES:
        raise BadInput(f"{where}: expected a file that ends in {' or '.join(SUFFIXES)}")
    try:
        content = read_whole(path)
        _require_few_entries(content, where)
        sheet = import_eds(StringIO(_text(content)), joint.settings.node)
    except OSError as error:
        raise BadInput(f"{where}: {error.strerror or error}: correct eds of this joint under link.joints") from None
    except BadInput:
        raise
    except Exception as error:  # configparser and canopen raise many kinds
        raise BadInput(f"{where}: not a valid EDS (CiA 306): {' '.join(str(error).split())}") from None
    if joint.settings.torque != "record":  # a stock device is asked what it has
        return sheet
    if object_dictionary.TORQUE_READING.index not in sheet:
        raise BadInput(
            f"{where}: the device has no torque sensor record 2100h: write `drive: {{family: canopen, node: "
            f"{joint.settings.node}, torque: motor}}`, which reads the torque estimate of the drive (docs/drives.md)"
        )
    for entry in used_objects():
        found = sheet.get_variable(entry.index, entry.sub)
        if found is None and entry not in OPTIONAL:
            raise BadInput(f"{where}: lacks {entry}, which the link needs (see docs/adding-a-drive.md)")
        if found is not None and len(found) != entry.bits:
            raise BadInput(f"{where}: {entry} has {len(found)} bits, expected {entry.bits}")
    for pdo in LINK_PDOS:
        for entry in pdo.entries:
            if not sheet.get_variable(entry.index, entry.sub).pdo_mappable:
                raise BadInput(f"{where}: {entry} cannot be mapped into a PDO, but the link needs it in {pdo.name}")
    return sheet


def _text(content: bytes) -> str:
    """Text of a data sheet: CiA 306 says ASCII, makers' editors write UTF-8 or Windows-1252."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def _require_few_entries(content: bytes, where: str) -> None:
    """Raise BadInput where an array has more entries than the eight bits of a sub-index count."""
    for stated in re.findall(rb"(?im)^\s*NrOfEntries\s*[=:]\s*(\S+)", content):
        if not stated.isdigit() or int(stated[:9]) > MOST_ENTRIES:
            raise BadInput(f"{where}: NrOfEntries {stated[:20].decode(errors='replace')}, expected 0 to {MOST_ENTRIES}")


def expected_identity(joint: LinkJoint, sheet: Any) -> DeviceIdentity:
    """Identity that a joint's controller must have: from the arm file, else vendor and product of its data sheet.

    The revision of the data sheet is not required: a data sheet often serves later revisions too.
    """
    if joint.eds is None:
        return joint.identity
    device = sheet.device_information
    stated = DeviceIdentity(vendor=device.vendor_number or None, product=device.product_number or None)
    return stated.model_copy(update=joint.identity.model_dump(exclude_none=True))
