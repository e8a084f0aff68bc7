"""The nominal model of an arm file: its URDF or MJCF, or its joints with the masses of its `sim` section."""

from pathlib import Path
from typing import Any

from armlink.arm_file import load_arm
from armlink.errors import BadInput


def nominal_spec(path: Path) -> Any:
    """The arm file at a path (or the bundled arm of that name) as a `mujoco.MjSpec`, effects left out.

    Raises BadInput where the file carries no masses.
    """
    arm = load_arm(str(path))
    if arm.sim is not None:
        from sim_bus.effects.state import Imperfections
        from sim_bus.physics.mjcf import build_model

        spec = build_model(arm, Imperfections(arm.joint_names)).spec
        for joint in spec.joints:
            joint.frictionloss = 0.0  # the plant sets its friction as it runs
        return spec
    if arm.model_path is None:
        raise BadInput(f"{path}: carries no masses: give kinematics.model (URDF or MJCF), a sim section, or --sim MJCF")
    from sim_gap.model.load import read_spec

    return read_spec(arm.model_path)
