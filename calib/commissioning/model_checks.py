"""Findings about an arm file's model: joints, limits, meshes, gravity."""

from collections.abc import Iterator

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.findings import SetupFinding
from armlink.model_file import NOT_FOUND, UNFETCHED, read_model
from calib.arm.kinematics import gcomp_arm, model_arm
from calib.commissioning.model_judgement import NO_MASS, largest_levers
from calib.plan.sweep_plan import DEAD_LEVER

SMALL_LEVER = 0.2
"""Γ/g below which the torque gain becomes imprecise; a choice."""
EARTH_GRAVITY = (9.7, 9.9)
"""Lowest and highest acceleration of gravity that is usual on Earth [m/s²]."""


def model_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Findings about kinematics and model; raises BadInput where the model cannot be used at all."""
    where = str(arm_file.path)
    if arm_file.model_path is None:
        yield SetupFinding(
            "hint",
            "collisions cannot be checked: the arm file has Denavit-Hartenberg rows and no model",
            where,
            "give a URDF or MJCF under kinematics.model, or keep the workspace clear",
        )
    else:
        yield from file_findings(arm_file)
        yield from _massless_links(arm_file)
    yield from _lever_findings(arm_file)


def _massless_links(arm_file: ArmFile) -> Iterator[SetupFinding]:
    model = model_arm(arm_file)
    lacking = [name for name, mass in zip(model.arm.names, model.mass, strict=True) if mass < NO_MASS]
    if lacking:
        what = f"the links moved by {', '.join(lacking)} have no mass in the model"
        remedy = "add their masses and centres of mass to the model: until then demo and torque calculate without them"
        yield SetupFinding("warning", what, str(arm_file.model_path), remedy)


def file_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Inertias and collision shapes of the arm file's model that are ignored or missing."""
    assert arm_file.model_path is not None
    where = str(arm_file.model_path)
    model = read_model(arm_file.model_path)
    if model.unphysical:
        yield SetupFinding(
            "warning",
            f"these inertias have a negative principal moment and are ignored: {', '.join(model.unphysical)}",
            where,
            "correct the inertia of these links: until then their torque under acceleration is not modelled",
        )
    if model.left_out:
        reasons = {reason for _, reason in model.unused_meshes}
        remedy = "convert these meshes to binary STL or OBJ, or keep the workspace clear"
        if NOT_FOUND in reasons:
            remedy = (
                "put the meshes where the model names them (package://NAME/… is looked for in the folders "
                "above the model)"
            )
        elif UNFETCHED in reasons:
            remedy = "run `git lfs pull` in the folder where the model was cloned"
        yield SetupFinding("warning", f"the collision geometry is incomplete: {model.left_out}", where, remedy)
    elif not model.shapes:
        yield SetupFinding(
            "warning",
            "the model has no collision geometry, so collisions are not checked",
            where,
            "add collision shapes to the model, or keep the workspace clear",
        )


def _lever_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    arm, where = gcomp_arm(arm_file), str(arm_file.path)
    size = float(np.linalg.norm(arm.gravity))
    if not EARTH_GRAVITY[0] < size < EARTH_GRAVITY[1]:
        remedy = "give kinematics.gravity in m/s² in the base frame, such as [0, 0, -9.81]"
        yield SetupFinding("warning", f"gravity is {size:.3g} m/s², not 9.81", f"{where}: kinematics.gravity", remedy)
    lever = largest_levers(arm)
    for joint, name in enumerate(arm.names):
        if lever[joint] < DEAD_LEVER:
            axis = "its axis is vertical" if joint == 0 else "its axis is vertical in every pose"
            yield SetupFinding(
                "warning",
                f"gravity does not load this joint, since {axis}, so its torque gain cannot be found (Γ/g, "
                f"the share of gravity that acts on it, is {lever[joint]:.2f})",
                name,
                "incline the base for the sweeps, or accept that this gain stays unknown",
            )
        elif lever[joint] < SMALL_LEVER:
            yield SetupFinding(
                "hint",
                "gravity loads this joint only a little (Γ/g, the share of gravity that acts on it, is at most "
                f"{lever[joint]:.2f}), so its torque gain will be imprecise",
                name,
                "incline the base for the sweeps, or widen the ranges of the joints before it",
            )
