"""The nominal model of an arm file: its URDF or MJCF, or its joints with the masses of its `sim` section."""

from pathlib import Path
from typing import Any

from armlink.armfile import load_arm
from armlink.errors import BadInput


def nominal_model(path: Path) -> Any:
    """Compile the arm file at a path (or the bundled arm of that name) to a `mujoco.MjModel`, effects left out.

    Raises BadInput where the file carries no masses.
    """
    arm = load_arm(str(path))
    if arm.sim is not None:
        from sim_bus.effects.state import Imperfections
        from sim_bus.mjcf import build_model

        model = build_model(arm, Imperfections(arm.joint_names)).model
        model.dof_frictionloss[:] = 0.0  # the plant sets its friction as it runs
        return model
    if arm.model_path is None:
        raise BadInput(f"{path}: carries no masses: give kinematics.model (URDF or MJCF), a sim section, or --sim MJCF")
    from sim_gap.model import compiled

    return compiled(arm.model_path)
