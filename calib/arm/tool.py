"""The tool that an arm carries: its mass moments, and how a command is given another."""

import numpy as np

from armlink.arm_file import ArmFile, Tool
from armlink.errors import BadInput
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.arrays import Array


def tool_moments(arm: Arm, tool: Tool | None) -> Array:
    """Mass moments that the tool adds (2n,) [kg·m]; equation (P) of docs/theory.md."""
    if tool is None:
        return np.zeros(2 * arm.n)
    at_origin, by_point = payload_columns(arm)
    moments: Array = tool.mass * (at_origin + by_point @ np.array(tool.centre))
    return moments


def tool_covariance(arm: Arm, tool: Tool | None) -> Array:
    """Covariance of the mass moments that the tool adds (2n, 2n) [kg²·m²]."""
    if tool is None:
        return np.zeros((2 * arm.n, 2 * arm.n))
    at_origin, by_point = payload_columns(arm)
    of_mass = tool.mass_std * (at_origin + by_point @ np.array(tool.centre))
    of_centre = tool.mass * tool.centre_std * by_point
    covariance: Array = np.outer(of_mass, of_mass) + of_centre @ of_centre.T
    return covariance


def parse_tool(text: str) -> Tool | None:
    """`MASS,X,Y,Z` [kg, m], or `0` for none; raises BadInput."""
    try:
        mass, *centre = (float(part) for part in text.split(","))
    except ValueError:
        mass, centre = np.nan, []
    if mass == 0 and len(centre) in (0, 3):
        return None
    if not 0 < mass < np.inf or len(centre) != 3 or not np.isfinite(centre).all():
        raise BadInput(
            f"--tool {text}: expected MASS,X,Y,Z: mass [kg] and centre of mass [m] in the frame that turns with the "
            "last joint, or 0 for no tool"
        )
    return Tool(mass=mass, centre=(centre[0], centre[1], centre[2]))


def with_tool(arm_file: ArmFile, text: str | None) -> ArmFile:
    """The arm with the tool of an option `--tool`; without one as the file has it. Raises BadInput."""
    return arm_file if text is None else arm_file.model_copy(update={"tool": parse_tool(text)})
