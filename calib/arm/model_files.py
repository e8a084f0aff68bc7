"""Identified mass moments in files: a URDF or MJCF model, and base parameters as parameters of a ROS 2 node."""

from pathlib import Path

import numpy as np

from armlink.content.atomic_file import write_whole, writing
from armlink.content.yaml_text import yaml_document
from calib.arm.urdf import URDF, urdf_of
from gcomp.arm.arm import Arm
from gcomp.arm.consistent_bodies import with_moments
from gcomp.arm.inertials import write_bodies
from gcomp.arm.load import PlacedChain, compiled_spec
from gcomp.arm.mass_moments import base_parameter_names
from gcomp.arrays import Array

GHOST = 1e-12
"""Mass below which a body is one that a URDF file gives none [kg]."""


def write_model(placed: PlacedChain, source: Path, beta: Array, path: Path) -> None:
    """Write the model of the file `source` with mass moments β (2n,) [kg·m], as URDF if `path` ends so, else as MJCF.

    Raises BadInput where it cannot be written.
    """
    spec, nominal = compiled_spec(source)
    write_bodies(spec, nominal, with_moments(placed, beta))
    compiled = spec.compile()
    if path.suffix.lower() == URDF:
        compiled.body_mass[compiled.body_mass < GHOST] = 0.0
        text = urdf_of(compiled, source if source.suffix.lower() == URDF else None)[0]
    else:
        text = spec.to_xml()
    with writing(path):
        write_whole(path, text)


def write_coefficients(arm: Arm, beta: Array, std: Array, path: Path) -> None:
    """Write base parameters as YAML; raises BadInput where it cannot be written.

    Torque is τ = Y(q) β, Y the regressor of docs/identification.md for these Denavit-Hartenberg rows.
    """
    every = [f"mass_moment_{axis}[{name}]" for name in arm.names for axis in "xy"]
    acting = [every.index(name) for name in base_parameter_names(arm)]
    rows = {key: getattr(arm, key).tolist() for key in ("alpha", "a", "d", "theta_offset")}
    parameters = {
        "joints": list(arm.names),
        "gravity": arm.gravity.tolist(),
        "denavit_hartenberg": {**rows, "b": np.asarray(arm.b).tolist()},
        "base_parameters": {
            "names": [every[k] for k in acting],
            "values": beta[acting].tolist(),
            "standard_deviations": std[acting].tolist(),
        },
    }
    with writing(path):
        write_whole(path, yaml_document({"/**": {"ros__parameters": {"gravity_model": parameters}}}))
