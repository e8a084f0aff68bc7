"""The nominal model of an arm file: its URDF or MJCF, or its joints with the masses of its `sim` section."""

from pathlib import Path
from typing import Any

from armlink.arm_file import bundled_arms, load_arm
from armlink.errors import BadInput


def ends_of(source: Any) -> tuple[str | None, str | None]:
    """Bodies between which the arm of an arm file lies in its model (`kinematics.base`, `kinematics.tip`), or None."""
    if not isinstance(source, str | Path) or not is_arm_file(Path(source)):
        return None, None
    kinematics = load_arm(str(source)).kinematics
    return kinematics.base, kinematics.tip


def is_arm_file(path: Path) -> bool:
    """Whether this is an arm file (by path or bundled name) and no model."""
    return path.suffix in (".yaml", ".yml") or str(path) in bundled_arms()


def nominal_model(path: Path) -> Any:
    """Path of the model of an arm file (by path or bundled name), or the `mujoco.MjSpec` of its `sim` section.

    The model counts if the section gives no masses of its own, so that both give the same answer. The section's effects
    are left out. Raises BadInput if the file has no masses.
    """
    arm = load_arm(str(path))
    if arm.model_path is not None and not (isinstance(arm.sim, dict) and arm.sim.get("links")):
        return arm.model_path
    if arm.sim is not None:
        from sim_bus.effects.state import Imperfections
        from sim_bus.physics.mjcf import build_model

        spec = build_model(arm, Imperfections(arm.joint_names)).spec
        for joint in spec.joints:
            joint.frictionloss = 0.0  # the simulated arm sets its friction at run time
        return spec
    raise BadInput(f"{path}: has no masses: give kinematics.model (URDF or MJCF), a sim section, or --sim MJCF")
