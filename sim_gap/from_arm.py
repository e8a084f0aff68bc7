"""The nominal simulation model of an arm file: its bodies and gravity, without its `sim.effects`."""

from pathlib import Path
from typing import Any

from armlink.armfile import load_arm
from sim_bus.mjcf import build_model


def nominal_model(path: str | Path) -> Any:
    """The arm as a compiled `mujoco.MjModel` with ideal joints; raises BadInput where the file has no `sim` section."""
    model = build_model(load_arm(path)).model
    model.dof_frictionloss[:] = 0.0
    return model
