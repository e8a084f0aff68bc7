"""Files for training: the corrected model, and draws of all parameters from what the recordings leave open."""

from pathlib import Path

from armlink.errors import BadInput
from sim_gap.better_model.samples import write_rows
from sim_gap.better_model.urdf import URDF, urdf_of
from sim_gap.closed_loop.identify import Identified
from sim_gap.closed_loop.judge import draw
from sim_gap.closed_loop.search import effect_there
from sim_gap.closed_loop.training.export import BATCHED, NATIVE, Exported, exported, native_fit
from sim_gap.model.load import urdf_behind


def write_samples(found: Identified, count: int, path: Path, seed: int = 0) -> None:
    """Write draws of all fitted parameters, one row each, columns `JOINT.PARAMETER` in SI units. Raises BadInput."""
    write_rows(draw(found.search, found.fit, found.spread, count, seed), path)


def write_exported(found: Identified, path: Path) -> tuple[str, ...]:
    """Write the corrected model as MJCF, or as URDF if the path ends so; a line per effect that it leaves out.

    If it needs PID actuators, which MuJoCo Warp does not run, `NAME_batch.xml` beside it does without; that of an
    earlier model is removed if it does not. URDF has no actuators: theirs are the entries of `--out-actuators`. Raises
    BadInput.
    """
    import mujoco

    if found.export is None:
        raise BadInput("--out-model: the model did not come from a file: give MJCF, URDF or an arm file with --sim")
    text, lines = found.export.xml, found.export.lines
    if path.suffix == URDF:
        text, told = urdf_of(mujoco.MjModel.from_xml_string(text), urdf_behind(found.sim.path), lines)
        lines = tuple(told)
    try:
        path.write_text(text, encoding="utf-8")
        if path.suffix != URDF and (other := batched(found)) is not None:
            batch_path(path).write_text(other.xml, encoding="utf-8")
        else:
            batch_path(path).unlink(missing_ok=True)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror}") from None
    return lines


def batched(found: Identified) -> Exported | None:
    """The corrected model without PID actuators, fitted again without them; None if it has none."""
    native = found.native
    if not any(effect_there(native, effect, j) for effect in set(NATIVE) - BATCHED for j in range(found.sim.n)):
        return None
    bare = native_fit(found.search, native, BATCHED)
    return exported(found.sim, found.search, found.fit, bare, BATCHED)


def batch_path(path: Path) -> Path:
    """File of the model without PID actuators beside that of the corrected model."""
    return path.with_name(f"{path.stem}_batch{path.suffix}")
