"""The model that a command is given: an arm file, or a URDF or MJCF file alone, with the tool that the arm carries."""

from dataclasses import dataclass
from pathlib import Path

from armlink.arm_file import MODEL_SUFFIXES, ArmFile, load_arm
from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput
from calib.arm.kinematics import gcomp_arm, model_arm, model_chain
from calib.arm.tool import parse_tool, tool_moments, with_tool
from gcomp.arm.arm import Arm
from gcomp.arm.load import PlacedChain, place_chain
from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class StatedModel:
    """An arm, and the model file and the arm file behind it."""

    arm: Arm
    placed: PlacedChain | None
    """The chain in its model file; None for an arm of Denavit-Hartenberg rows."""
    path: Path | None
    """The model file."""
    beta: Array | None
    """Mass moments of the model file and the tool (2n,) [kg·m]; None without one."""
    arm_file: ArmFile | None = None


def stated_model(model: str, base: str | None = None, tip: str | None = None, tool: str | None = None) -> StatedModel:
    """Of a bundled arm, an arm file, or a URDF or MJCF file with the ends of its chain; raises BadInput, BadModel.

    `tool` is that of an option `--tool`; without one it is the arm file's.
    """
    path = Path(model)
    if path.suffix.lower() in MODEL_SUFFIXES:
        if not path.is_file():
            raise BadInput(f"there is no model file {model}: give the path of a URDF or MJCF file, or of an arm file")
        with model_budget(path):
            placed = place_chain(path, base=base, tip=tip)
        moments = tool_moments(placed.arm.arm, None if tool is None else parse_tool(tool))
        return StatedModel(placed.arm.arm, placed, path, placed.arm.beta + moments)
    if base is not None or tip is not None:
        raise BadInput("--base, --tip: only for a URDF or MJCF file; an arm file describes its chain under kinematics")
    arm_file = with_tool(load_arm(model), tool)
    if arm_file.model_path is None:
        return StatedModel(gcomp_arm(arm_file), None, None, None, arm_file)
    placed = model_chain(arm_file)
    found = model_arm(arm_file, placed)
    return StatedModel(found.arm, placed, arm_file.model_path, found.beta, arm_file)
