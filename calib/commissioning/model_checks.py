"""Whether a model and its torque limits can be those of an arm: one judgement for all that rests upon them.

And findings about joints, limits, meshes and gravity, and about what the drives must do: hold the arm, press joints on
their stops, sweep without a collision.
"""

import math
from collections.abc import Iterator

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.findings import SetupFinding
from armlink.errors import BadInput
from armlink.link.joints.values import try_limits
from armlink.model_file import FLAT, NOT_FOUND, UNFETCHED, read_model
from calib.arm.kinematics import DriveLimits, gcomp_arm, model_arm, model_chain
from calib.arm.sweep_section import sweep_motion, sweep_section
from calib.plan.collisions import check_plan
from calib.plan.creep_plan import plan_creep, refuse_unbearable_creeps
from calib.plan.planned_arm import PlannedArm
from calib.plan.rough_gravity import HAND, GravityGuess, guess_of_file, guess_of_model, known_torques, reach
from calib.plan.stop_selection import stop_combinations
from calib.plan.sweep_plan import DEAD_LEVER, plan_sweep, refuse_unbearable_mass
from gcomp.arm.arm import Arm
from gcomp.arm.load import ModelArm, joint_inertias
from gcomp.arrays import Array
from gcomp.gravity.torque import gravity_levers, gravity_torque

NO_MASS = 1e-9
"""Mass of all moving links that stands for none [kg]: the reader gives massless bodies a negligible one."""
LIGHTEST, HEAVIEST = 0.1, 1000.0
"""Mass of the moving links over the cube of the reach [kg/m³] that an arm may have. Published arms, legs and hands have
1.2 to 81 (57 models of example-robot-data and rtb-data), a two-link arm of 1 kg/m has 0.25; with grams taken for
kilograms or the reverse they have 1200 or more, or 0.081 or less."""
SAME_POINT = 1e-4
"""Lever [m] of a mass below which axes are said to meet in one point; models have rounded lengths."""
POSES = 500
"""Random poses at which the torque against gravity is looked at."""


def refuse_impossible_model(arm_file: ArmFile) -> None:
    """Raise BadInput in the words of doctor where a model's masses or the torque limits cannot be those of an arm."""
    for found in arm_errors(arm_file):
        raise BadInput(str(found))


def refuse_impossible_sweep(arm_file: ArmFile, reference_mass: float) -> None:
    """Raise BadInput as `refuse_impossible_model`, and where the drives cannot hold a reference mass [kg] in sweeps."""
    for found in sweep_errors(arm_file):
        raise BadInput(str(found))
    if not reference_mass:
        return
    if sweep_motion(arm_file) == "creep":
        refuse_unbearable_creeps(arm_file, reference_mass)
    else:
        refuse_unbearable_mass(arm_file, reference_mass, guess_of_file(arm_file))


def arm_errors(arm_file: ArmFile) -> list[SetupFinding]:
    """Errors of the model, of an arm without geometry, or of one that stands so that gravity loads no joint."""
    found, where = list(model_errors(arm_file)), str(arm_file.path)
    if found:
        return found
    if not arm_file.has_geometry:
        what = "the geometry of the arm is not known, so nothing can be swept or identified"
        remedy = (
            "give a, alpha and d of every joint, or make the arm file from the arm's URDF or MJCF: armlink new --help"
        )
        return [SetupFinding("error", what, where, remedy)]
    if (largest_levers(gcomp_arm(arm_file)) < DEAD_LEVER).all():
        what = "gravity loads no joint in any pose, so nothing can be calibrated"
        remedy = "incline the base, then give the inclined gravity here"
        return [SetupFinding("error", what, f"{where}: kinematics.gravity", remedy)]
    return []


def sweep_errors(arm_file: ArmFile) -> list[SetupFinding]:
    """Errors of the arm, or of one whose sweeps would tell no torque gain."""
    return arm_errors(arm_file) or list(gain_errors(arm_file))


def gain_errors(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """The error that a reference mass tells no torque gain: a mass at one point of the last link loads no joint.

    All that it shows are then products of a gain and its unknown distance from this point.
    """
    if not arm_file.has_geometry:
        return
    arm = gcomp_arm(arm_file)
    if np.abs(known_torques(arm, _poses(arm))).max() < SAME_POINT * np.linalg.norm(arm.gravity):
        yield SetupFinding(
            "error",
            "the axes of all joints that gravity loads pass through one point, so a mass whose place is unknown cannot "
            "tell the torque gains",
            str(arm_file.path),
            "add a joint whose axis passes elsewhere (--base, --tip), or trust the drives' torques and learn gravity "
            "from poses at rest: armlink identify POSES --model MODEL",
        )


def model_errors(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Errors in masses or torque limits, each with its remedy; those that follow from another are left out."""
    model = None if arm_file.model_path is None else model_arm(arm_file)
    impossible = None if model is None else mass_error(str(arm_file.model_path), model)
    if impossible is not None:
        yield impossible
        return
    if arm_file.link is None:
        return
    try:
        try_limits(arm_file)
    except BadInput as error:
        what, _, remedy = str(error).rpartition(": ")
        yield SetupFinding("error", what, f"{arm_file.path}: link.joints", remedy)
        return
    if model is not None:
        yield from (found for found in _strength(arm_file, model) if found.level == "error")


def largest_levers(arm: Arm) -> Array:
    """Γ/g (n,) of each joint at its largest in the range of the joints; NaN where there is no gravity."""
    with np.errstate(invalid="ignore"):
        return np.asarray(gravity_levers(arm, _poses(arm)).max(axis=0) / np.linalg.norm(arm.gravity))


def gravity_need(model: ModelArm) -> Array:
    """Largest torque against gravity (n,) [N·m] in the range of the joints."""
    return np.asarray(np.abs(gravity_torque(model.arm, model.beta, _poses(model.arm))).max(axis=0))


def _poses(arm: Arm, count: int = POSES) -> Array:
    low, high = np.nan_to_num([arm.lower, arm.upper], neginf=-np.pi, posinf=np.pi)
    return np.random.default_rng(0).uniform(low, high, (count, arm.n))


def mass_error(where: str, model: ModelArm) -> SetupFinding | None:
    """Masses of the model file `where` that are missing, or that no arm of its size has."""
    mass = float(model.mass.sum())
    if mass < NO_MASS:
        return SetupFinding(
            "error",
            "the model states no masses, so there is no gravity to calibrate with or to simulate",
            where,
            "give the links the masses and centres of mass that the maker states (URDF: inertial), or use a "
            "model that has them",
        )
    last = 2 * float(np.linalg.norm(model.beta[-2:])) / max(float(model.mass[-1]), NO_MASS)
    length = float(reach(model.arm, max(HAND, last))[0])
    if LIGHTEST < mass / length**3 < HEAVIEST:
        return None
    usual = f"arms of this size weigh {_usual(LIGHTEST, length)} to {_usual(HEAVIEST, length)} kg"
    what = f"the moving links weigh {mass:.3g} kg at a reach of {length:.2g} m, but {usual}"
    return SetupFinding("error", what, where, "write masses in kg and lengths in m")


def _usual(density: float, length: float) -> str:
    return f"{float(f'{density * length**3:.1g}'):g}"


def _strength(arm_file: ArmFile, model: ModelArm) -> Iterator[SetupFinding]:
    """Joints whose drives can hardly hold the arm against gravity, or cannot."""
    most = DriveLimits.of(arm_file).max_torque
    for name, need, limit in zip(model.arm.names, gravity_need(model), most, strict=True):
        needed = f"according to the model, gravity needs up to {need:.3g} N·m"
        if need > limit:
            what = f"{needed}, but max_torque is {limit:g} N·m: the arm would fall"
            yield SetupFinding("error", what, name, "check the model's masses and max_torque, or narrow the ranges")
        elif limit < TORQUE_RESERVE * need:
            what = f"{needed} of max_torque {limit:g} N·m, so little torque is left"
            yield SetupFinding("warning", what, name, "narrow the ranges, or allow more torque if the drive has it")


SMALL_LEVER = 0.2
"""Γ/g below which the torque gain becomes imprecise; a choice."""
EARTH_GRAVITY = (9.7, 9.9)
"""Lowest and highest acceleration of gravity that is usual on Earth [m/s²]."""


def model_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Findings about kinematics and model; raises BadInput where the model cannot be used at all."""
    where = str(arm_file.path)
    if arm_file.model_path is None:
        what = "collisions cannot be checked: the arm file has Denavit-Hartenberg rows and no model"
        remedy = "give a URDF or MJCF under kinematics.model, or keep the workspace clear"
        yield SetupFinding("hint", what, where, remedy)
    else:
        yield from file_findings(arm_file)
        model = model_arm(arm_file)
        lacking = [name for name, mass in zip(model.arm.names, model.mass, strict=True) if mass < NO_MASS]
        if lacking:
            what = f"the links moved by {', '.join(lacking)} have no mass in the model"
            remedy = (
                "add their masses and centres of mass to the model: until then demo and torque calculate without them"
            )
            yield SetupFinding("warning", what, str(arm_file.model_path), remedy)
    yield from _lever_findings(arm_file)


def file_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Inertias and collision shapes of the arm file's model that are ignored or missing."""
    assert arm_file.model_path is not None
    where = str(arm_file.model_path)
    model = read_model(arm_file.model_path)
    unphysical = model.unphysical_beyond(arm_file.joint_names[0])
    if unphysical:
        what = f"the inertia of {', '.join(unphysical)} has a negative principal moment and is ignored"
        remedy = "correct it: until then the torque under acceleration of this link is not modelled"
        yield SetupFinding("warning", what, where, remedy)
    if model.left_out:
        reasons = {reason for _, reason in model.unused_meshes}
        remedy = "convert these meshes to binary STL or OBJ, or keep the workspace clear"
        if NOT_FOUND in reasons:
            folders = "package://NAME/… is looked for in the folders above the model"
            remedy = f"put the meshes where the model names them ({folders})"
        elif UNFETCHED in reasons:
            remedy = "run `git lfs pull` in the folder where the model was cloned"
        elif reasons == {FLAT}:
            remedy = "replace these meshes by boxes in the model, or keep the workspace clear"
        yield SetupFinding("warning", f"the collision geometry is incomplete: {model.left_out}", where, remedy)
    elif not model.shapes:
        what = "the model has no collision geometry, so collisions are not checked"
        remedy = "add collision shapes to the model, or keep the workspace clear"
        yield SetupFinding("warning", what, where, remedy)


def _lever_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    arm, where = gcomp_arm(arm_file), str(arm_file.path)
    size = float(np.linalg.norm(arm.gravity))
    if not EARTH_GRAVITY[0] < size < EARTH_GRAVITY[1]:
        remedy = "give kinematics.gravity in m/s² in the base frame, such as [0, 0, -9.81]"
        yield SetupFinding("warning", f"gravity is {size:.3g} m/s², not 9.81", f"{where}: kinematics.gravity", remedy)
    lever = largest_levers(arm)
    for joint, name in enumerate(arm.names):
        if lever[joint] < DEAD_LEVER:
            axis = "its axis is vertical" if joint == 0 else "its axis is vertical in every pose"
            yield SetupFinding(
                "warning",
                f"gravity does not load this joint, since {axis}, so its torque gain cannot be found (Γ/g, "
                f"the share of gravity that acts on it, is {lever[joint]:.2f})",
                name,
                "incline the base for the sweeps, or accept that this gain stays unknown",
            )
        elif lever[joint] < SMALL_LEVER:
            yield SetupFinding(
                "hint",
                "gravity loads this joint only a little (Γ/g, the share of gravity that acts on it, is at most "
                f"{lever[joint]:.2f}), so its torque gain will be imprecise",
                name,
                "incline the base for the sweeps, or widen the ranges of the joints before it",
            )


TORQUE_RESERVE = 1.2
"""Torque that a drive should have over gravity, as a factor; a choice: friction and acceleration need the rest."""
LEAST_DAMPING = 0.3
"""Damping ratio of a joint that its drive holds with stiffness and damping alone; below it swings after each move."""
FASTEST_RATE = 20.0
"""A torque limit that is reached in less than its inverse [1/s] is a blow; a choice."""


def motion_findings(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Findings about torques, stops and the sweeps; raises BadInput or Refused where no sweep can be planned."""
    if arm_file.link is None:
        return
    for joint in arm_file.link.joints:
        if joint.max_torque > 3 * joint.rated_torque:
            what = (
                f"max_torque {joint.max_torque:g} N·m is more than three times rated_torque {joint.rated_torque:g} N·m"
            )
            yield SetupFinding("warning", what, joint.name, "compare them with the rating and the limit of the drive")
        if joint.max_torque_rate > FASTEST_RATE * joint.max_torque:
            what = (
                f"with max_torque_rate {joint.max_torque_rate:g} N·m/s the full torque comes within "
                f"{1e3 / FASTEST_RATE:.0f} ms"
            )
            yield SetupFinding("hint", what, joint.name, f"about {2.5 * joint.max_torque:.3g} N·m/s is usual")
    guess, creeping = None, sweep_motion(arm_file) == "creep"
    if arm_file.model_path is not None:
        model = model_arm(arm_file)
        guess = guess_of_model(model.arm, model.beta)
        yield from _strength(arm_file, model)
        yield from _damping(arm_file)
        if (
            not creeping
            and sweep_section(arm_file).hold == "stops"
            and np.isfinite([model.arm.lower, model.arm.upper]).all()
        ):
            yield from _stops(arm_file, guess)
    if creeping:
        plan_creep(arm_file)  # raises where it cannot be made; the model's own findings have the joints without load
        return
    plan = plan_sweep(arm_file, guess)
    check_plan(arm_file, plan)
    for note in plan.notes:
        what, _, remedy = note.partition(": ")
        yield SetupFinding("warning", what, str(arm_file.path), remedy or "see docs/sweeps.md")


def largest_inertias(arm_file: ArmFile) -> dict[str, float]:
    """Largest inertia that each joint turns, the reference mass of a sweep included [kg·m²]; the arm has a model."""
    placed = model_chain(arm_file)
    poses, mass = _poses(placed.arm.arm, 100), sweep_section(arm_file).reference_mass or 0.0  # few: it changes little
    return dict(zip(placed.arm.arm.names, joint_inertias(placed, poses, mass).max(axis=0).tolist(), strict=True))


def _damping(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Joints that their drives hold with kp and kd, and whose kd is too low for what they turn."""
    assert arm_file.link is not None
    joints = [joint for joint in arm_file.link.joints if getattr(joint.settings, "kp", 0.0) > 0]
    if not joints:
        return
    largest = largest_inertias(arm_file)
    for joint in joints:
        drive, inertia = joint.settings, largest[joint.name]
        square = drive.gear**2
        ratio = drive.kd * square / (2 * math.sqrt(drive.kp * square * inertia))
        if ratio < LEAST_DAMPING:
            enough = 2 * LEAST_DAMPING * math.sqrt(drive.kp * inertia / square)
            softer = square * (drive.kd / (2 * LEAST_DAMPING)) ** 2 / inertia
            what = f"kd {drive.kd:g} gives a damping ratio of only {ratio:.2f} at an inertia of {inertia:.2g} kg·m²"
            remedy = (
                f"set kd to {enough:.2g} or more, or kp to {softer:.2g} or less, which gives a damping ratio "
                f"of {LEAST_DAMPING:g}"
            )
            yield SetupFinding("warning", what, joint.name, remedy)


def _stops(arm_file: ArmFile, guess: GravityGuess) -> Iterator[SetupFinding]:
    """Joints that cannot be pressed on any stop within max_torque while another is swept."""
    planned = PlannedArm(arm_file, guess)
    arm, ever = planned.arm, np.zeros(planned.arm.n, dtype=bool)
    for joint in range(arm.n):
        candidates = stop_combinations(arm, joint, planned.sweep_range(joint))
        ever |= planned.pressable_joints(candidates).any(axis=0) & (np.arange(arm.n) != joint)
    what = "this joint cannot be pressed on a stop within max_torque"
    remedy = "hold joints at rest by their position loops (`sweep: {hold: servo}`), or allow more torque"
    for name, pressed in zip(arm.names, ever, strict=True):
        if not pressed and arm.n > 1:
            yield SetupFinding("warning", what, name, remedy)
