"""Electronic data sheets (EDS, CiA 306) of joint controllers: what the arm file names for a joint, else our own."""

from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

import canopen

from armlink.arm_file import ArmFile, DeviceIdentity, LinkJoint
from armlink.canopen import object_dictionary
from armlink.canopen.object_dictionary import Entry
from armlink.canopen.pdo import LINK_PDOS
from armlink.errors import BadInput

SUFFIXES = (".eds", ".dcf")
OPTIONAL = {
    object_dictionary.TORQUE_OFFSET: "torque offset: nothing latched to clear",
    object_dictionary.PROFILE_VELOCITY: "profile velocity: no profile position mode",
    object_dictionary.TORQUE_SLOPE: "torque slope: no profile torque mode",
    object_dictionary.STORE_MANUFACTURER: "store: a calibration is lost at power-off",
    object_dictionary.HEARTBEAT_PRODUCER: "",
}
"""Objects that a controller may lack, and what it then does not do."""


def used_objects() -> Iterable[Entry]:
    """The objects of a controller that the link uses."""
    return [value for value in vars(object_dictionary).values() if isinstance(value, Entry)]


def bundled_path() -> str:
    """Path of the data sheet that this package ships."""
    return str(files("armlink.canopen").joinpath("eds/joint.eds"))


def bundled() -> Any:
    """The object dictionary of a joint controller from the shipped data sheet, for node 1."""
    return canopen.import_od(bundled_path(), 1)


def of_joints(arm: ArmFile) -> tuple[Any, ...]:
    """The object dictionary of each joint's controller, in joint order; raises BadInput as read_sheet."""
    joints, read = arm.require_link().joints, dict[str | None, Any]()
    for joint in joints:
        if joint.eds not in read:
            read[joint.eds] = bundled() if joint.eds is None else read_sheet(arm.path.parent / joint.eds, joint)
    return tuple(read[joint.eds] for joint in joints)


def read_sheet(path: Path, joint: LinkJoint) -> Any:
    """The object dictionary that a joint's own data sheet describes.

    Raises BadInput where the file cannot be read, or where it lacks an object that the link uses, or has it with
    another length, or not to be mapped into a PDO that the link needs it in.
    """
    where = f"{joint.name}: data sheet {path}"
    if path.suffix.lower() not in SUFFIXES:
        raise BadInput(f"{where}: expected a file that ends in {' or '.join(SUFFIXES)}")
    try:
        sheet = canopen.import_od(str(path), joint.node)
    except OSError as error:
        raise BadInput(f"{where}: {error.strerror or error}: correct eds of this joint under link.joints") from None
    except Exception as error:  # configparser's and canopen's own, of many kinds
        raise BadInput(f"{where}: not an EDS as CiA 306 has it: {' '.join(str(error).split())}") from None
    for entry in used_objects():
        found = sheet.get_variable(entry.index, entry.sub)
        if found is None and entry not in OPTIONAL:
            raise BadInput(f"{where}: lacks {entry}, which the link needs: docs/adding-a-drive.md says what for")
        if found is not None and len(found) != entry.bits:
            raise BadInput(f"{where}: {entry} has {len(found)} bits, expected {entry.bits}")
    for pdo in LINK_PDOS:
        for entry in pdo.entries:
            if not sheet.get_variable(entry.index, entry.sub).pdo_mappable:
                raise BadInput(f"{where}: {entry} cannot be mapped into a PDO, and the link needs it in {pdo.name}")
    return sheet


def expected_identity(joint: LinkJoint, sheet: Any) -> DeviceIdentity:
    """Which controller a joint must have: what the arm file states, and vendor and product of the joint's data sheet.

    The revision is not taken from it: a data sheet often serves later revisions too.
    """
    if joint.eds is None:
        return joint.identity
    told = sheet.device_information
    held = DeviceIdentity(vendor=told.vendor_number or None, product=told.product_number or None)
    return held.model_copy(update=joint.identity.model_dump(exclude_none=True))
