"""The model that a command is given: an arm file, or a URDF or MJCF file alone."""

from dataclasses import dataclass
from pathlib import Path

from armlink.arm_file import MODEL_SUFFIXES, ArmFile, load_arm
from armlink.content.model_sizes import model_budget
from armlink.errors import BadInput
from calib.arm.kinematics import gcomp_arm, model_chain
from gcomp.arm.arm import Arm
from gcomp.arm.load import PlacedChain, place_chain


@dataclass(frozen=True, eq=False)
class StatedModel:
    """An arm, and the model file and the arm file behind it."""

    arm: Arm
    placed: PlacedChain | None
    """The chain in its model file; None for an arm of Denavit-Hartenberg rows."""
    path: Path | None
    """The model file."""
    arm_file: ArmFile | None = None

    @property
    def has_inertials(self) -> bool:
        return self.placed is not None and bool(self.placed.arm.beta.any())


def stated_model(model: str, base: str | None = None, tip: str | None = None) -> StatedModel:
    """Of a bundled arm, an arm file, or a URDF or MJCF file with the ends of its chain; raises BadInput, BadModel."""
    path = Path(model)
    if path.suffix.lower() in MODEL_SUFFIXES:
        if not path.is_file():
            raise BadInput(f"there is no model file {model}: give the path of a URDF or MJCF file, or of an arm file")
        with model_budget(path):
            placed = place_chain(path, base=base, tip=tip)
        return StatedModel(placed.arm.arm, placed, path)
    if base is not None or tip is not None:
        raise BadInput("--base, --tip: only for a URDF or MJCF file; an arm file describes its chain under kinematics")
    arm_file = load_arm(model)
    chain = None if arm_file.model_path is None else model_chain(arm_file)
    return StatedModel(gcomp_arm(arm_file), chain, arm_file.model_path, arm_file)
