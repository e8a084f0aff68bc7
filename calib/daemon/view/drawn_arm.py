"""The arm's shape as an answer of the API."""

from armlink.arm_file import ArmFile
from calib.arm.skeleton import skeleton
from calib.daemon.view.api_models import DrawnArm, DrawnJoint


def drawn_arm(arm: ArmFile) -> DrawnArm:
    """The arm of an arm file; reads its model file, if it has one, and raises BadInput or OSError if it cannot."""
    drawn = skeleton(arm)
    columns = zip(
        arm.joint_names,
        drawn.axes.tolist(),
        drawn.points.tolist(),
        drawn.reference.tolist(),
        (link.tolist() for link in drawn.links),
        strict=True,
    )
    keys = ("joint", "axis", "point", "reference", "link")
    joints = tuple(DrawnJoint.model_validate(dict(zip(keys, column, strict=True))) for column in columns)
    return DrawnArm.model_validate({"up": drawn.up.tolist(), "joints": joints})
