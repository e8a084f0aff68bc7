"""Contradictions between the nodes on a bus and an arm file: absent, another controller, other ratings; only read."""

from collections.abc import Iterator

from armlink.arm_file import ArmFile
from armlink.bus.can_bus import CanBus
from armlink.drives.canopen.check.found_drives import FoundNodes
from armlink.drives.canopen.controller_setup import identity_mismatches
from armlink.drives.canopen.eds_file import expected_identity, of_joints
from armlink.drives.canopen.units import RATED_TORQUE_TOLERANCE
from armlink.drives.findings import SetupFinding


def arm_findings(arm_file: ArmFile, opened: CanBus, bus: str) -> Iterator[SetupFinding]:
    """Findings about the drives of an arm on an open bus of this name; raises BusFault."""
    link, drives = arm_file.require_link(), FoundNodes(opened)
    by_node, ours = {each.node: each for each in drives.found}, {joint.settings.node for joint in link.joints}
    spare = [each.node for each in drives.found if each.node not in ours]
    unknown = f"; nodes {', '.join(map(str, spare))} answer and are in no joint" if spare else ""
    for joint, sheet in zip(link.joints, of_joints(arm_file, link.joints), strict=True):
        node = joint.settings.node
        where, drive = f"{joint.name} (node {node})", by_node.get(node)
        if drive is None:
            find = f"armlink new {arm_file.argument} --bus {bus} --out found.yaml"
            remedy = f"check its power, wiring and node id{unknown}; the drives are found by {find}"
            yield SetupFinding("error", f"no answer on {bus}", where, remedy)
            continue
        for differs in identity_mismatches(expected_identity(joint, sheet), vars(drives.identities[node])):
            remedy = "connect the right arm, or correct identity under link.joints"
            yield SetupFinding("error", f"another controller: {differs}", where, remedy)
        if abs(drive.rated_torque - joint.rated_torque) > RATED_TORQUE_TOLERANCE * joint.rated_torque:
            what = f"its rated torque (6076h) is {drive.rated_torque:g} N·m, the arm file has {joint.rated_torque:g}"
            yield SetupFinding(
                "error", what, where, f"set rated_torque: {drive.rated_torque:g}, or connect its own drive"
            )
        if drive.max_torque < joint.max_torque * (1 - RATED_TORQUE_TOLERANCE):
            what = f"the drive allows {drive.max_torque:g} N·m (6072h), max_torque is {joint.max_torque:g}"
            yield SetupFinding("warning", what, where, f"lower max_torque to {drive.max_torque:g}, or raise 6072h")
    if spare and len(drives.found) - len(spare) == len(link.joints):
        what = f"nodes {', '.join(map(str, spare))} answer and belong to no joint"
        yield SetupFinding("hint", what, bus, "a gripper or another arm: nothing is sent to them")
