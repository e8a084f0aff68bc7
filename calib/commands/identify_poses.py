"""`armlink identify` of poses of any robot, with its model: gravity, gains and friction, model files, coefficients."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armlink.errors import BadInput
from calib.arm.kinematics import StatedModel, stated_model
from calib.fit.calibration import rms
from calib.fit.pose_fit import SENSOR_GAIN_STD, PoseFit, fit_poses
from calib.fit.recorded_rows import load_poses
from gcomp.arrays import Array, Mask
from gcomp.identify.motor_model import MotorDoubt

if TYPE_CHECKING:
    from armlink.commands.plain_console import PlainConsole
    from armlink.recording.corrections import Corrections
    from calib.records.store import RecordStore

WRITTEN_SUFFIXES = (".urdf", ".xml")


@dataclass(frozen=True, eq=False)
class Judged:
    """A fit, beside the model's own mass moments with all else fitted: RMS of held-out readings (n,) [N·m]."""

    fit: PoseFit
    held_out: Array
    nominal: Array

    @property
    def passed(self) -> bool:
        """Whether the mass moments make held-out readings as likely as the model's own moments do, or more."""
        seen = (self.held_out > 0) & (self.nominal > 0)
        return bool(np.log(self.held_out[seen] / self.nominal[seen]).sum() <= 0)


def judged_fit(
    model: StatedModel,
    poses: Sequence[Path],
    heldout: Sequence[Path],
    masses: dict[str, float],
    gain_std: float | None,
    stated: "Corrections | None" = None,
) -> Judged:
    """The fit of poses, judged by those in `heldout` or else by cross-validation; raises BadInput."""
    readings, channel, sources = load_poses(poses, model, masses, stated)
    if gain_std is None:
        gain_std = SENSOR_GAIN_STD if channel == "torque" else MotorDoubt.gain
    link = None if model.arm_file is None else model.arm_file.link
    rated = np.full(model.arm.n, float(np.nanmax(np.abs(readings.torque)))) if link is None else link.rated_torques
    nominal = np.zeros(2 * model.arm.n) if model.beta is None else model.beta
    fit = fit_poses(model.arm, readings, rated, nominal, gain_std, sources)
    plain = fit.with_nominal_moments()
    if not heldout:
        return Judged(fit, fit.held_out(), plain.held_out())
    held, other, _ = load_poses(heldout, model, masses, stated)
    if other != channel:
        raise BadInput(f"--heldout {heldout[0]}: its torque channel differs from that of the poses")
    return Judged(fit, rms(fit.errors(held)), rms(plain.errors(held)))


def reference_masses(given: Sequence[str], poses: Sequence[Path]) -> dict[str, float]:
    """FILE=KG → mass by path; raises BadInput."""
    masses = dict[str, float]()
    for text in given:
        path, _, number = text.rpartition("=")
        try:
            mass = float(number)
        except ValueError:
            mass = np.nan
        if not path or not 0 < mass < np.inf:
            raise BadInput(f"--reference-mass {text}: expected FILE=KG, such as loaded.csv=2.5")
        if Path(path) not in poses:
            raise BadInput(f"--reference-mass {text}: {path} is not one of the given files of poses")
        masses[str(Path(path))] = mass
    return masses


def identify_poses(
    poses: Sequence[Path],
    model: str,
    stated: "Corrections",
    store: "RecordStore",
    json_file: Path | None,
    *,
    base: str | None,
    tip: str | None,
    reference_mass: Sequence[str] | None,
    heldout: Sequence[Path] | None,
    gain_std: float | None,
    out_model: Path | None,
    coefficients: Path | None,
    plan: int | None,
) -> int:
    from armlink.commands.output import write_json
    from armlink.commands.plain_console import PlainConsole, results
    from calib.arm.model_files import write_coefficients, write_model

    described = stated_model(model, base, tip)
    if out_model is not None and (described.placed is None or out_model.suffix.lower() not in WRITTEN_SUFFIXES):
        raise BadInput(
            f"--out-model {out_model}: expected a name that ends in .urdf or .xml, and a URDF or MJCF file as --model"
        )
    masses = reference_masses(reference_mass or (), poses)
    if masses and not set(map(str, poses)) - set(masses):
        raise BadInput("--reference-mass: a mass hangs in all poses: give poses without it, too")
    with PlainConsole().status("fitting mass moments, and predicting poses that were held out"):
        judged = judged_fit(described, poses, heldout or (), masses, gain_std, stated)
    fit, arm_file, record = judged.fit, described.arm_file, None
    if arm_file is not None:
        kept = fit.gravity.record(arm_file)
        store.put(kept, arm_file, by="armlink identify", reason="poses")
        record = kept.id
    out = results(json_file)
    _show(judged, out)
    if record is not None:
        out.print(f"record {record} is current")
    if out_model is not None and described.placed is not None and described.path is not None:
        write_model(described.placed, described.path, fit.gravity.beta, out_model)
        out.print(f"{out_model}: the model with these mass moments; all its bodies are physically possible")
    if coefficients is not None:
        write_coefficients(described.arm, fit.gravity.beta, fit.gravity.std, coefficients)
        out.print(f"{coefficients}: base parameters, and the names of the regressor's columns")
    further = fit.best_poses(plan) if plan else None
    if further is not None:
        _show_plan(judged, *further, out)
    write_json(json_file, _answer(judged, record, further))
    return 0 if judged.passed else 1


def _answer(judged: Judged, record: str | None, further: tuple[Array, Array] | None) -> dict[str, Any]:
    fit = judged.fit
    values = {name: fit.estimate(name) for name in ("gain", "offset", "coulomb", "load", "rho")}
    answer: dict[str, Any] = {
        "schema": "armlink.poses/1",
        "record": record,
        "joints": list(fit.arm.names),
        "poses": len(fit.readings),
        "beta": fit.gravity.beta.tolist(),
        "std": fit.gravity.std.tolist(),
        "identifiable": fit.gravity.identifiable.tolist(),
        "not_determined": list(fit.not_determined),
        "gravity_rms95": fit.bound(fit.readings.position).tolist(),
        "gain": _known(*values["gain"], fit.found("gain")),
        "offset": _known(*values["offset"], fit.found("offset")),
        "coulomb": _known(*values["coulomb"], fit.found("coulomb")),
        "load_friction": _known(*values["load"], fit.found("load")),
        "scale": fit.scale or None,
        "reference_mass": fit.mass or None,
        "reference_point": values["rho"][0].tolist() if fit.mass else None,
        "residual_rms": fit.gravity.residual_rms.tolist(),
        "held_out": {"rms": judged.held_out.tolist(), "model_rms": judged.nominal.tolist(), "passed": judged.passed},
        "plan": None if further is None else {"poses": further[0].tolist(), "gravity_rms95": further[1].tolist()},
    }
    return answer


def _known(value: Array, std: Array, found: Mask) -> dict[str, list[float]]:
    """Estimates and 95 % intervals; NaN, in JSON null, for what the poses do not tell."""
    half = 1.96 * std
    interval = np.stack([value - half, value + half], axis=1)
    return {
        "estimated": np.where(found, value, np.nan).tolist(),
        "ci95": np.where(found[:, None], interval, np.nan).tolist(),
    }


def _show(judged: Judged, console: "PlainConsole") -> None:
    from calib.commands.screen import print_intervals, print_lines

    fit = judged.fit
    beta, half = np.where(fit.gravity.identifiable, fit.gravity.beta, np.nan), 1.96 * fit.gravity.std
    nothing = np.zeros(fit.arm.n)
    columns = {
        "x [kg·m]": (beta[0::2], half[0::2]),
        "y [kg·m]": (beta[1::2], half[1::2]),
        "gravity ± [N·m]": (fit.bound(fit.readings.position), nothing),
    }
    print_intervals(
        "Mass moments ± half of the 95 % interval, bound of the RMS error of gravity", fit.arm.names, columns, console
    )
    sensors = {}
    for title, family in (("gain", "gain"), ("offset [N·m]", "offset"), ("Coulomb friction [N·m]", "coulomb")):
        value, std = fit.estimate(family)
        sensors[title] = np.where(fit.found(family), value, np.nan), 1.96 * std
    print_intervals("Torque readings and friction, ± half of the 95 % interval", fit.arm.names, sensors, console)
    held = {
        "these moments": (judged.held_out, nothing),
        "the model's own": (judged.nominal, nothing),
    }
    print_intervals("Held-out readings: RMS error [N·m]", fit.arm.names, held, console)
    lines = [f"not determined: {each}" for each in fit.not_determined]
    further = np.ptp(fit.readings.position, axis=0) > fit.arm.upper - fit.arm.lower
    if further.any():
        lines.append(
            f"doubtful: the poses of {', '.join(np.array(fit.arm.names)[further])} go further than the limits of the "
            "model allow: are the positions in rad (--units q=deg), and the limits of an MJCF model (without "
            '<compiler angle="radian"/> they are degrees)?'
        )
    worse = "failed: held-out readings are less likely with these mass moments than with the model's own"
    better = "passed: held-out readings are at least as likely with these mass moments as with the model's own"
    print_lines([*lines, better if judged.passed else worse], console=console)


def _show_plan(judged: Judged, poses: Array, bound: Array, console: "PlainConsole") -> None:
    from rich.table import Table

    table = Table("pose", *judged.fit.arm.names, title="Further poses that would help most [rad]")
    for number, pose in enumerate(poses, start=1):
        table.add_row(str(number), *(f"{value:+.3f}" for value in pose))
    console.print(table)
    after = ", ".join(f"{name} {value:.2g}" for name, value in zip(judged.fit.arm.names, bound, strict=True))
    console.print(
        "if these poses are approached and read from both sides, the bound of the RMS error of gravity becomes [N·m]: "
        f"{after}. The poses are within the joint limits; they were not checked for collisions"
    )
