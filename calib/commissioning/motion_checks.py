"""Findings about what the drives must do: hold the arm, press joints on their stops, sweep without a collision."""

import math
from collections.abc import Iterator

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.findings import SetupFinding
from calib.arm.kinematics import DriveLimits, model_arm, model_chain
from calib.arm.sweep_section import sweep_motion, sweep_section
from calib.commissioning.model_checks import gravity_need
from calib.plan.collisions import check_plan
from calib.plan.creep_plan import plan_creep
from calib.plan.planned_arm import PlannedArm
from calib.plan.rough_gravity import GravityGuess, guess_of_model
from calib.plan.stop_selection import stop_combinations
from calib.plan.sweep_plan import plan_sweep
from gcomp.arm.load import ModelArm, joint_inertias

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


def _strength(arm_file: ArmFile, model: ModelArm) -> Iterator[SetupFinding]:
    limits = DriveLimits.of(arm_file)
    for name, need, most in zip(model.arm.names, gravity_need(model), limits.max_torque, strict=True):
        if need <= most < TORQUE_RESERVE * need:
            what = (
                f"according to the model, gravity needs up to {need:.3g} N·m of max_torque {most:g} N·m, so "
                "little torque is left"
            )
            yield SetupFinding("warning", what, name, "narrow the ranges, or allow more torque if the drive has it")


def largest_inertias(arm_file: ArmFile) -> dict[str, float]:
    """Largest inertia that each joint turns, the reference mass of a sweep included [kg·m²]; the arm has a model."""
    placed = model_chain(arm_file)
    arm = placed.arm.arm
    low, high = np.nan_to_num([arm.lower, arm.upper], posinf=np.pi, neginf=-np.pi)
    # few: an inertia changes little from pose to pose
    poses = np.random.default_rng(0).uniform(low, high, (100, arm.n))
    mass = sweep_section(arm_file).reference_mass or 0.0
    return dict(zip(arm.names, joint_inertias(placed, poses, mass).max(axis=0).tolist(), strict=True))


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
    for name, pressed in zip(arm.names, ever, strict=True):
        if pressed or arm.n == 1:
            continue
        yield SetupFinding(
            "warning",
            "this joint cannot be pressed on a stop within max_torque",
            name,
            "hold joints at rest by their position loops (`sweep: {hold: servo}`), or allow more torque",
        )
