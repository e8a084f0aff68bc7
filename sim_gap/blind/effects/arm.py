"""Joints, links and base that differ from the nominal model: sensors, friction, gears, motors, drives, masses, tilt."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from gcomp.arm.inertials import steiner
from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm, compile_arm, inverse
from sim_gap.blind.effects.drawn_effect import (
    ArmSetting,
    Draw,
    DrawnEffect,
    SizedDraw,
    Values,
    on_joint,
    pick,
    reverses_often,
    sign,
)
from sim_gap.blind.motion import RECORDED_HZ
from sim_gap.blind.scene import LEAST_SPEED, THINNED_S, Scene, rms

PERIOD_S = 1.0 / RECORDED_HZ
"""Sample interval of the recordings [s]: shorter delays do not show, and those of drives take two to four."""
XYZ = ("x", "y", "z")
INERTIA = (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2))
SLOW = "needs steps, a chirp or faster logging"


def has_varying_load(scene: Scene, _: Array) -> Any:
    size = np.abs(scene.torque)
    return (size.std(0) > 0.4 * size.mean(0)) & (rms(size) > 3.0)


def angle_error(scene: Scene, random: np.random.Generator, shape: Array) -> Array:
    """Factor (n,) on a joint's position error (K', n) of this shape at which some joint's torque shows it."""
    shown = scene.turn_felt(shape) / scene.sensor_level(random)[:, None]
    return np.asarray(1.0 / np.maximum(shown.max(0), 1e-9))


def sensor_limit(scene: Scene, random: np.random.Generator) -> Array:
    """The level that clips the wanted RMS of a torque reading."""
    level, size = scene.sensor_level(random), np.abs(scene.torque)
    limits = np.array([np.quantile(size, q, axis=0) for q in np.linspace(0.98, 0.6, 20)])
    enough = np.greater([rms(np.maximum(size - limit, 0.0)) for limit in limits], level)
    first = limits[np.argmax(enough, axis=0), np.arange(scene.arm.n)]
    return np.where(enough.any(0), first, np.inf)


def motor_limit(scene: Scene, random: np.random.Generator) -> Array:
    """Above the torque that holds the arm against gravity, below the peaks of its motion."""
    size = np.abs(scene.motor_torque)
    limits = np.maximum(1.1 * np.abs(scene.gravity).max(0) + 0.3, np.quantile(size, random.uniform(0.85, 0.93), axis=0))
    return np.where(rms(np.maximum(size - limits, 0.0)) >= 0.15, limits, np.inf)


def gear_stiffness(scene: Scene, random: np.random.Generator) -> Array:
    """From the RMS deflection [rad]; of a joint that shows it by 0.25 N·m, with a resonance above 4 Hz."""
    stiffness = rms(scene.torque) / random.uniform(0.015, 0.04)
    shown = scene.turn_felt(scene.torque / stiffness).max(0) > 0.25
    return np.where(shown & (stiffness >= (2 * np.pi * 4.0) ** 2 * scene.inertia), stiffness, np.inf)


def gear_play(scene: Scene, random: np.random.Generator) -> Array:
    felt = scene.turn_felt(np.ones_like(scene.torque)).max(0)
    return np.asarray(2.2 * np.maximum(scene.sensor_level(random), 0.2) / np.maximum(felt, 1e-9))


def heavy_rotor(scene: Scene, j: int) -> dict[str, Any]:
    """The nominal arm with a rotor of 12 % of the joint's inertia or more: behind a spring the simulated arm has none
    below a tenth."""
    least = float(0.12 / (1.0 - 0.12) * scene.link_inertia[j])
    return {"nominal": lambda arm: arm.with_entries(j, armature=max(float(arm.armature[j]), least))}


def offset_twin(scene: Scene, j: int) -> dict[str, Any]:
    """Effects that do the same as an offset of the first or last joint's angle, as fields of DrawnEffect."""
    if j == 0:
        return {"undecided": "at joint 1 a base tilt has the same effect", "confused_with": ("base.tilt",)}
    if j == scene.arm.n - 1:
        why = "at the last joint a mass moment has the same effect"
        return {"undecided": why, "confused_with": ("link.mass_moment",)}
    return {}


def late_drive(effect: str, other: str) -> SizedDraw:
    """A lag or delay, at a joint whose torque changes fast enough to show it; slow motion confuses it with another."""
    return SizedDraw(
        effect,
        "time",
        lambda scene, random: np.full(scene.arm.n, random.uniform(2.0 * PERIOD_S, 4.0 * PERIOD_S)),
        shows=lambda scene, time: time * rms(np.gradient(scene.motor_torque, THINNED_S, axis=0)) >= 0.1,
        more=lambda scene, j: {"undecided": SLOW, "confused_with": (other,)},
    )


SIZED = (
    SizedDraw("torque.offset", "offset", lambda s, r: s.sensor_level(r) * r.uniform(1.0, 2.0), sound=0.0),
    SizedDraw("torque.gain", "gain", lambda s, r: s.sensor_level(r) / rms(s.torque), 0.06, 0.25, sound=1.0),
    SizedDraw("torque.drift", "rate", lambda s, r: 2.5 * s.sensor_level(r) / s.seconds, sound=0.0),
    SizedDraw(
        "torque.hysteresis",
        "width",
        lambda s, r: 1.4 * s.sensor_level(r),
        most=lambda s: 0.2 * np.subtract(*np.quantile(s.torque, [0.95, 0.05], axis=0)),  # it swings far beyond a play
    ),
    SizedDraw(
        "torque.deadband",
        "width",
        lambda s, r: 1.3 * s.sensor_level(r),
        most=lambda s: 0.4 * rms(s.torque),
        shows=reverses_often,
    ),
    SizedDraw("torque.saturation", "limit", sensor_limit),
    SizedDraw(
        "position.offset",
        "offset",
        lambda s, r: angle_error(s, r, np.ones_like(s.torque)),
        0.015,
        0.12,
        sound=0.0,
        more=offset_twin,
    ),
    SizedDraw("position.gain", "gain", lambda s, r: angle_error(s, r, s.motion[0]), 0.015, 0.06, sound=1.0),
    SizedDraw("friction.coulomb", "torque", lambda s, r: s.motor_level(r) * r.uniform(1.0, 2.0)),
    SizedDraw("friction.viscous", "damping", lambda s, r: s.motor_level(r) * r.uniform(1.0, 2.0) / rms(s.motion[1])),
    SizedDraw(
        "friction.load",
        "coefficient",
        lambda s, r: 1.5 * s.motor_level(r) / rms(s.torque),
        most=0.35,
        shows=has_varying_load,
    ),
    SizedDraw("transmission.elasticity", "stiffness", gear_stiffness, more=heavy_rotor),
    SizedDraw(
        "transmission.backlash",
        "width",
        gear_play,
        0.01,
        0.07,
        shows=lambda s, _: reverses_often(s, 0.1 * rms(s.torque)),
        more=heavy_rotor,
    ),
    SizedDraw("actuator.gain", "gain", lambda s, r: 1.3 * s.motor_level(r) / rms(s.motor_torque), 0.07, 0.3, sound=1.0),
    SizedDraw("actuator.rotor_inertia", "inertia", lambda s, r: s.motor_level(r) / rms(s.motion[2]), most=2.0),
    late_drive("actuator.lag", "actuator.delay"),
    late_drive("actuator.delay", "actuator.lag"),
    SizedDraw("actuator.saturation", "limit", motor_limit),
)
"""Effects of one parameter at one joint."""


def crosstalk(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    size = np.std(scene.torque, axis=0)
    source = int(random.choice(np.flatnonzero(size > 0.4 * size.max())))
    sizes = scene.sensor_level(random) / rms(scene.torque)[source]
    j = pick((sizes <= 0.2) & (np.arange(scene.arm.n) != source), random)
    if j is None:
        return None
    values = {"coefficient": sign(random) * float(sizes[j]), "source": float(source + 1)}
    put = ArmSetting("torque.crosstalk", scene.arm.names[j], {**values, "source": scene.arm.names[source]})
    return on_joint(scene, j, "torque.crosstalk", values, settings=(put,))


def eccentricity(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """An error with a period of one turn: true = read + amplitude·sin(read + phase)."""
    phase = float(random.uniform(-np.pi, np.pi))
    sizes = 1.3 * angle_error(scene, random, np.sin(scene.motion[0] + phase))
    far = np.ptp(scene.motion[0], axis=0) > 2.5  # a small part of a turn is an offset and a gain
    j = pick((sizes <= 0.08) & far, random)
    if j is None:
        return None
    return on_joint(scene, j, "position.eccentricity", {"amplitude": max(float(sizes[j]), 0.02), "phase": phase})


def delay(scene: Scene, random: np.random.Generator) -> DrawnEffect | None:
    """The torque sensor's reading delayed against the position, on one joint or on all."""
    change = np.gradient(scene.torque, THINNED_S, axis=0)
    sizes = np.maximum(scene.sensor_level(random) / rms(change), 2.0 * PERIOD_S)
    j = pick(sizes <= 0.04, random)
    if j is None:
        return None
    names = scene.arm.names if random.random() < 0.25 else (scene.arm.names[j],)
    values = {"delay": float(sizes[j])}
    settings = tuple(ArmSetting("timing.delay", name, values) for name in names)
    return DrawnEffect("timing.delay", dict.fromkeys(names, values), settings)


def _on_coulomb(
    scene: Scene, random: np.random.Generator, j: int, torque: float, effect: str, values: Values
) -> DrawnEffect:
    """An effect on top of Coulomb friction [N·m], which the nominal model has, or which is implied."""
    name = scene.arm.names[j]
    settings = ArmSetting("friction.coulomb", name, {"torque": torque}), ArmSetting(effect, name, values)
    if random.random() < 0.5:
        return on_joint(scene, j, effect, values, nominal=lambda arm: arm.with_entries(j, frictionloss=torque))
    return on_joint(scene, j, effect, values, settings=settings, implied=("friction.coulomb",))


def stribeck(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    level, speed = float(scene.motor_level(random)[j]), np.abs(scene.motion[1][:, j])
    moving = speed[speed > LEAST_SPEED]
    velocity = float(np.clip(np.quantile(moving, random.uniform(0.25, 0.5)), 0.05, 0.35))
    breakaway = float(1.2 * level / rms(np.exp(-((moving / velocity) ** 2))))
    values = {"breakaway": breakaway, "velocity": velocity}
    return _on_coulomb(scene, random, j, breakaway * random.uniform(0.8, 1.6), "friction.stribeck", values)


def asymmetric(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    j = int(random.integers(scene.arm.n))
    ratio = sign(random) * random.uniform(0.25, 0.6)
    base = float(1.5 * scene.motor_level(random)[j] / abs(ratio))
    return _on_coulomb(scene, random, j, base, "friction.asymmetric", {"ratio": ratio})


def ripple(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """Torque lost to the meshing gear: amplitude·sin(cycles·θ + phase), slow enough to pass a 6 Hz filter."""
    j = int(random.integers(scene.arm.n))
    fastest = float(np.quantile(np.abs(scene.motion[1][:, j]), 0.9))
    most = max(8.0, min(30.0, 2 * np.pi * 4.0 / max(fastest, 0.1)))
    values = {
        "amplitude": float(1.5 * scene.motor_level(random)[j]),
        "cycles": float(random.uniform(6.0, most)),
        "phase": float(random.uniform(-np.pi, np.pi)),
    }
    return on_joint(scene, j, "transmission.ripple", values)


def spring(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """A cable bundle across the joint: −stiffness·(θ − rest) on the link."""
    j = int(random.integers(scene.arm.n))
    q = scene.motion[0][:, j]
    stiffness = float(1.3 * max(scene.sensor_level(random)[j], 0.2) / q.std())
    rest = float(q.mean() + random.uniform(-0.5, 0.5) * q.std())
    return on_joint(scene, j, "transmission.spring", {"stiffness": stiffness, "rest": rest})


def coupling(scene: Scene, random: np.random.Generator) -> DrawnEffect:
    """The motor of a joint also turns with its neighbour; the nominal model does not have that motor."""
    n, names = scene.arm.n, scene.arm.names
    j = int(random.integers(1, n))
    k = j - 1 if j == n - 1 or random.random() < 0.7 else j + 1
    coefficient = sign(random) * (1.0 if random.random() < 0.6 else float(random.uniform(0.5, 0.9)))
    speed, push = (x[:, j] + coefficient * x[:, k] for x in scene.motion[1:])
    level = float(scene.motor_level(random)[[j, k]].max())
    rotor, coulomb, viscous = 0.5 * level / float(rms(push)), 1.5 * level, 0.8 * level / float(rms(speed))
    settings = (
        ArmSetting("transmission.coupling", names[j], {"coefficient": coefficient, "source": names[k]}),
        ArmSetting("actuator.rotor_inertia", names[j], {"inertia": rotor}),
        ArmSetting("friction.coulomb", names[j], {"torque": coulomb}),
        ArmSetting("friction.viscous", names[j], {"damping": viscous}),
    )
    without_motor = partial(BenchArm.with_entries, joint=j, armature=0.0, damping=0.0, frictionloss=0.0)
    own = {"inertia": rotor, "coulomb": coulomb, "viscous": viscous}
    values = {"coefficient": coefficient, "other_joint": float(k + 1), **own}
    implied = tuple(setting.effect for setting in settings[1:])
    return on_joint(
        scene, j, "transmission.coupling", values, settings=settings, nominal=without_motor, implied=implied
    )


# ---- links and base


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
        weight = inverse(compile_arm(moved), scene.motion[0], *np.zeros((2, *scene.torque.shape))) - scene.gravity
        weighs = rms(weight)[link] > 0.1 * _felt(scene, moved, link)
        why = "" if weighs else "the axis is vertical: a moved mass shows only in its inertia"
        others = () if weighs else ("link.inertia",)
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
    return arm.with_added(arm.n - 1, mass, mass * com, mass * steiner(com) + 0.002 * mass * np.eye(3))


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
    **{each.effect: each for each in SIZED},
    "torque.crosstalk": crosstalk,
    "position.eccentricity": eccentricity,
    "timing.delay": delay,
    "friction.stribeck": stribeck,
    "friction.asymmetric": asymmetric,
    "transmission.ripple": ripple,
    "transmission.spring": spring,
    "transmission.coupling": coupling,
}
