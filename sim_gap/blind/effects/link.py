"""Links, payload and base that differ from the nominal model."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect, sensor_level
from sim_gap.blind.scene import Scene, rms
from sim_gap.blind.true_arm import TrueArm

XYZ = ("x", "y", "z")
LEAST_WEIGHT_SHARE = 0.1
"""Share of a moved mass's torque that is its weight, below which it shows as an inertia alone."""
UPRIGHT = "the axis is upright: a moved mass shows by its inertia alone"
INERTIA = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))


def _scale(scene: Scene, other: BenchArm, joints: NDArray[np.intp], random: np.random.Generator) -> float:
    """Factor on a change at which it shows at the most sensitive of `joints`."""
    return float(1.0 / (rms(scene.change(other)) / sensor_level(scene, random))[joints].max())


def mass_moment(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A shifted centre of mass, across the link's own axis, so that its own joint shows it."""
    arm, level = scene.arm, sensor_level(scene, random)
    shift = random.uniform(0.15, 0.3)
    for link in random.permutation(arm.n).tolist():
        across = np.cross(arm.axis[link], random.standard_normal(3))
        unit = across / np.linalg.norm(across) * 1e-2
        wanted = level[link] / max(float(rms(scene.change(arm.with_moved(link, unit)))[link]), 1e-9)
        moment = unit * wanted
        if np.linalg.norm(moment) / arm.mass[link] > shift:
            continue
        moved = arm.with_moved(link, moment)
        weight, whole = (float(rms(change)[link]) for change in (scene.change_at_rest(moved), scene.change(moved)))
        weighs = weight > LEAST_WEIGHT_SHARE * whole

        def apply(true: TrueArm, link: int = link, moment: Array = moment) -> None:
            true.arm = true.arm.with_moved(link, moment)

        values = dict(zip(XYZ, moment.tolist(), strict=True))
        why, others = ("", ()) if weighs else (UPRIGHT, ("link.inertia",))
        return DrawnEffect.at(scene, link, "link.mass_moment", values, apply, undecided=why, confused_with=others)
    return None


def inertia(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Additional inertia, mostly about the joint's own axis, that no shift of mass explains."""
    arm, level = scene.arm, 1.3 * sensor_level(scene, random)
    for link in random.permutation(arm.n).tolist():
        axis = np.outer(arm.axis[link], arm.axis[link])
        unit = 0.01 * (0.55 * np.eye(3) + 0.45 * axis)
        wanted = level[link] / max(float(rms(scene.change(_thicker(arm, link, unit)))[link]), 1e-9)
        if 0.01 * wanted > 0.12 + 0.03 * float(arm.mass[link:].sum()):
            continue
        added = unit * wanted

        def apply(true: TrueArm, link: int = link, added: Array = added) -> None:
            true.arm = _thicker(true.arm, link, added)

        return DrawnEffect.at(scene, link, "link.inertia", {name: float(added[r, c]) for name, r, c in INERTIA}, apply)
    return None


def _thicker(arm: BenchArm, link: int, added: Array) -> BenchArm:
    out = replace(arm, inertia=arm.inertia.copy())
    out.inertia[link] += added
    return out


def payload(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    arm, tip = scene.arm, scene.arm.n - 1
    com = arm.com[tip] * 1.5 + random.uniform(-0.06, 0.06, 3)
    light = _loaded(arm, 0.5, com)
    mass = float(
        np.clip(0.5 * 1.5 * _scale(scene, light, np.arange(arm.n), random), 0.3, 6.0) * random.uniform(1.0, 1.5)
    )

    def apply(true: TrueArm) -> None:
        true.arm = _loaded(true.arm, mass, com)

    return DrawnEffect("link.payload", {"arm": {"mass": mass, **dict(zip(XYZ, com.tolist(), strict=True))}}, apply)


def _loaded(arm: BenchArm, mass: float, com: Array) -> BenchArm:
    about = mass * (com @ com * np.eye(3) - np.outer(com, com)) + 0.002 * mass * np.eye(3)
    return arm.with_added(arm.n - 1, mass, mass * com, about)


def tilt(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The base rotated by a small angle about an axis across gravity."""
    arm = scene.arm
    down = arm.gravity / np.linalg.norm(arm.gravity)
    axis = np.cross(down, random.standard_normal(3))
    axis /= np.linalg.norm(axis)
    wanted = 0.01 * _scale(scene, _tilted(arm, 0.01 * axis), np.arange(arm.n), random)
    if wanted > 0.12:
        return None
    turn = axis * max(wanted, 0.03)

    def apply(true: TrueArm) -> None:
        true.arm = _tilted(true.arm, turn)

    named = np.sort(
        np.argsort(np.abs(arm.gravity), kind="stable")[:2]
    )  # the two base axes closest to perpendicular to gravity
    aligned = np.abs(down).max() > 0.999
    values = {f"angle_{k + 1}": float(turn[axis]) for k, axis in enumerate(named)} if aligned else {}
    return DrawnEffect("base.tilt", {"arm": values}, apply)


def _tilted(arm: BenchArm, turn: Array) -> BenchArm:
    """The base rotated by the rotation vector `turn` [rad]: gravity rotates the other way in the base frame."""
    angle = float(np.linalg.norm(turn))
    axis, g = turn / angle, arm.gravity
    gravity = g * np.cos(angle) - np.cross(axis, g) * np.sin(angle) + axis * (axis @ g) * (1.0 - np.cos(angle))
    return replace(arm, gravity=gravity)


DRAWS: dict[str, Draw] = {
    "link.mass_moment": mass_moment,
    "link.inertia": inertia,
    "link.payload": payload,
    "base.tilt": tilt,
}
