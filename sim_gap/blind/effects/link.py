"""Links, payload and base that differ from the nominal model."""

from dataclasses import replace
from functools import partial

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm
from sim_gap.blind.effects.drawn_effect import Draw, DrawnEffect
from sim_gap.blind.scene import Scene, rms

XYZ = ("x", "y", "z")
UPRIGHT = "the axis is vertical: a moved mass shows only in its inertia"
INERTIA = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))


def _felt(scene: Scene, other: BenchArm, joint: int) -> float:
    """RMS torque that another arm causes at a joint [N·m]."""
    return max(float(rms(scene.change(other))[joint]), 1e-9)


def _scale(scene: Scene, other: BenchArm, random: np.random.Generator) -> float:
    """Factor on a change at which it shows at the most sensitive joint."""
    return float(1.0 / (rms(scene.change(other)) / scene.sensor_level(random)).max())


def mass_moment(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """A shifted centre of mass, across the link's own axis, so that its own joint shows it."""
    arm, level = scene.arm, scene.sensor_level(random)
    shift = random.uniform(0.15, 0.3)
    for link in random.permutation(arm.n).tolist():
        across = np.cross(arm.axis[link], random.standard_normal(3))
        unit = across / np.linalg.norm(across) * 1e-2
        moment = unit * (level[link] / _felt(scene, arm.with_moved(link, unit), link))
        if np.linalg.norm(moment) / arm.mass[link] > shift:
            continue
        moved = arm.with_moved(link, moment)
        weighs = rms(scene.change_at_rest(moved))[link] > 0.1 * _felt(scene, moved, link)
        why, others = ("", ()) if weighs else (UPRIGHT, ("link.inertia",))
        values = {arm.names[link]: dict(zip(XYZ, moment.tolist(), strict=True))}
        moves = partial(BenchArm.with_moved, link=link, moment=moment)
        return DrawnEffect("link.mass_moment", values, links=moves, undecided=why, confused_with=others)
    return None


def inertia(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """Additional inertia, mostly about the joint's own axis, that no shift of mass explains."""
    arm, level, nothing = scene.arm, 1.3 * scene.sensor_level(random), np.zeros(3)
    for link in random.permutation(arm.n).tolist():
        unit = 0.01 * (0.55 * np.eye(3) + 0.45 * np.outer(arm.axis[link], arm.axis[link]))
        wanted = level[link] / _felt(scene, arm.with_added(link, 0.0, nothing, unit), link)
        if 0.01 * wanted <= 0.12 + 0.03 * float(arm.mass[link:].sum()):
            added = unit * wanted
            values = {arm.names[link]: {name: float(added[r, c]) for name, r, c in INERTIA}}
            adds = partial(BenchArm.with_added, link=link, mass=0.0, moment=nothing, inertia=added)
            return DrawnEffect("link.inertia", values, links=adds)
    return None


def payload(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    tip = scene.arm.n - 1
    com = scene.arm.com[tip] * 1.5 + random.uniform(-0.06, 0.06, 3)
    wanted = 0.5 * 1.5 * _scale(scene, _loaded(scene.arm, 0.5, com), random)
    mass = float(np.clip(wanted, 0.3, 6.0) * random.uniform(1.0, 1.5))
    values = {"mass": mass, **dict(zip(XYZ, com.tolist(), strict=True))}
    return DrawnEffect("link.payload", {"arm": values}, links=lambda true: _loaded(true, mass, com))


def _loaded(arm: BenchArm, mass: float, com: Array) -> BenchArm:
    about = mass * (com @ com * np.eye(3) - np.outer(com, com)) + 0.002 * mass * np.eye(3)
    return arm.with_added(arm.n - 1, mass, mass * com, about)


def tilt(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    arm = scene.arm
    down = arm.gravity / np.linalg.norm(arm.gravity)
    across = np.cross(down, random.standard_normal(3))
    across /= np.linalg.norm(across)
    wanted = 0.01 * _scale(scene, _tilted(arm, 0.01 * across), random)
    if wanted > 0.12:
        return None
    turn = across * max(wanted, 0.03)
    # named are the two base axes closest to perpendicular to gravity
    axes = np.sort(np.argsort(np.abs(arm.gravity), kind="stable")[:2])
    aligned = np.abs(down).max() > 0.999
    values = {f"angle_{k + 1}": float(turn[axis]) for k, axis in enumerate(axes)} if aligned else {}
    return DrawnEffect("base.tilt", {"arm": values}, links=lambda true: _tilted(true, turn))


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
