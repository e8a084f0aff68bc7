"""Reads the nominal model: MJCF, URDF, or an arm file with a model or with masses in its `sim` section."""

from pathlib import Path
from typing import Any

from armlink.errors import BadInput


def compiled(path: Path) -> Any:
    """Compile an MJCF, URDF or arm file (by path or bundled name) to a `mujoco.MjModel`. Raises BadInput."""
    try:
        return read_spec(path).compile()
    except ValueError as error:
        raise BadInput(f"{path}: MuJoCo cannot compile it: {_line(error)}") from None


def read_spec(path: Path) -> Any:
    """Read an MJCF, URDF or arm file (by path or bundled name) as a `mujoco.MjSpec`. Raises BadInput."""
    from armlink.arm_file import bundled_arms

    if path.suffix in (".yaml", ".yml") or str(path) in bundled_arms():
        return _of_arm_file(path)
    return _of_model_file(path)


def _of_model_file(path: Path) -> Any:
    import mujoco

    if not path.is_file():
        raise BadInput(f"no model file {path}: give an MJCF, URDF or arm file")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise BadInput(f"{path}: MuJoCo cannot read it: {_line(error)}") from None


def _of_arm_file(path: Path) -> Any:
    """The arm's URDF or MJCF, or its joints with the masses of its `sim` section, effects left out."""
    from armlink.arm_file import load_arm

    arm = load_arm(str(path))
    if arm.sim is not None:
        from sim_bus.effects.state import Imperfections
        from sim_bus.physics.mjcf import build_model

        spec = build_model(arm, Imperfections(arm.joint_names)).spec
        for joint in spec.joints:
            joint.frictionloss = 0.0  # the simulated arm sets its friction at run time
        return spec
    if arm.model_path is None:
        raise BadInput(f"{path}: has no masses: give kinematics.model (URDF or MJCF), a sim section, or --sim MJCF")
    return _of_model_file(arm.model_path)


def _line(error: ValueError) -> str:
    """MuJoCo's message, which spans several lines, in one."""
    return " ".join(str(error).split())
