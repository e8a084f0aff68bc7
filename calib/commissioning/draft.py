"""Draft of an arm file from a model: every value with where it comes from; its text marks what was assumed."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from armlink.arm_file import SIMULATED, STANDARD_GRAVITY
from armlink.content.model_sizes import model_budget
from armlink.content.yaml_text import yaml_comment, yaml_entry, yaml_item
from calib.commissioning.chain import Chain
from gcomp.arm.load import compile_model
from gcomp.arrays import Array

NO_BUS = "assumed: there is no bus yet"
GUESSES = yaml_comment(
    "Comments mark guessed values: check each value before a real arm moves, then remove its comment."
)
ASSUMED_STOP = 2.9
"""Working range of a joint without stops, to either side [rad]; assumed."""
SPEED = 1.0
"""Largest speed, where the model allows more [rad/s]: cautious for the first motion; assumed."""
RATE_TIME = 0.4
"""Time in which the commanded torque may go from zero to the largest [s]; assumed."""
LOAD_FACTOR = 3.0
"""Rated torque over the largest that the arm's own masses need, where the model states none; assumed."""
ACCELERATION = 1.0
"""Acceleration that this need includes, beside gravity [rad/s²]; assumed."""
LEAST_TORQUE = 2.0
"""Least such rated torque [N·m], on a small arm that of its strongest joint; assumed."""
LEAST_RATING = 1e-3
"""Smallest rated torque that is written [N·m]: a model without masses needs none."""
MOST_RESERVE = 10.0
"""Effort limit over the load, at the joint where that is least, beyond which a model's effort limits are none of its
drives: published arms have up to 6; placeholders, and limits copied from larger arms, 11 to 5000."""
FRICTION = 0.02
"""Coulomb friction of the simulated arm, as a share of the torque that its drives need; assumed."""
ROTOR = 1e-3
"""Rotor inertia behind the gear of the simulated arm over its drive's rated torque [s²], where the model has none;
assumed. Published models have 0.3 (iiwa) to 10 (SO-100) thousandths, the Panda 1.1. A strong drive without its rotor
would throw a light joint."""


@dataclass
class JointDraft:
    """One joint of the draft; `notes` are comments for the file, values named first."""

    name: str
    node: int
    rated_torque: float
    max_torque: float
    max_torque_rate: float
    max_velocity: float
    friction: float
    """Coulomb friction of the simulated arm [N·m]."""
    rotor: float
    """Its rotor inertia, at the joint [kg·m²]; 0 where the model has one."""
    stops: tuple[float, float] | None = None
    """Only where the model has none, or others were given [rad]."""
    notes: list[str] = field(default_factory=list)


@dataclass
class Draft:
    name: str
    model: Path
    tip: str | None
    gravity: tuple[float, float, float]
    joints: list[JointDraft]
    aside: tuple[tuple[str, str], ...]
    notes: list[str]
    serial: str = "unknown"
    base: str | None = None
    servo: str | None = None
    """Why resting joints are held by their servos rather than pressed on stops; None: they are pressed."""
    locked: Mapping[str, float] = field(default_factory=dict)
    """Joints that are held at this position [rad, m] by other means than the arm's drives."""

    @property
    def assumed(self) -> list[str]:
        """Everything that was assumed, as `joint: value`."""
        return [*self.notes, *(f"{joint.name}: {note}" for joint in self.joints for note in joint.notes)]


def draft_of_model(
    name: str,
    path: Path,
    chain: Chain,
    gravity: tuple[float, float, float],
    stops: Mapping[str, tuple[float, float]],
    ratings: Mapping[str, float] | None = None,
    locked: Mapping[str, float] | None = None,
) -> Draft:
    """The draft for one chain; `stops` [rad], `ratings` [N·m] and `locked` [rad, m] by joint name were given.

    Raises BadModel.
    """
    tip = chain.tip if chain.aside else None
    notes = []
    if not np.any(gravity):
        gravity = STANDARD_GRAVITY
        notes.append("gravity: the model gives none, so it is assumed to point down")
    need = _load_torque(path, [joint.name for joint in chain.joints], gravity, locked or {})
    rated = _ratings(chain, need, ratings or {})
    doubted: dict[str, list[str]] = {}
    for joint, rating in zip(chain.joints, rated, strict=True):
        if rating.source == "load":
            doubted.setdefault(rating.doubt, []).append(joint.name)
    for doubt, names in doubted.items():
        who = "every joint" if len(names) == len(rated) else ", ".join(names)
        notes.append(
            f"rated torques assumed ({who}): {doubt}; if you know the rating of a drive, give --rated-torque "
            "JOINT:TORQUE"
        )
    joints = [_joint(place, chain, stops.get(joint.name), rated[place]) for place, joint in enumerate(chain.joints)]
    free = [joint.name for joint in joints if joint.stops is not None and joint.name not in stops]
    servo = f"{', '.join(free)} {'have' if len(free) > 1 else 'has'} no stop to be pressed on" if free else None
    ends = name, path, tip, gravity, joints, chain.aside, notes
    return Draft(*ends, base=chain.base, servo=servo, locked=locked or {})


@dataclass(frozen=True)
class Rating:
    """Rated torque of a drive, as far as the model tells it."""

    torque: float
    """[N·m]"""
    needed: float
    """Rating that the load alone suggests [N·m]."""
    source: Literal["given", "model", "load"]
    doubt: str
    """Why the model's effort limit is not believed; empty where it is."""

    @property
    def note(self) -> str:
        if self.source == "load":
            return f"rated_torque assumed: {LOAD_FACTOR:g} times the load, since {self.doubt}"
        if self.source == "model":
            return "rated_torque assumed to be the effort limit of the model: compare it with the rating of the drive"
        return ""


def _ratings(chain: Chain, need: Array, given: Mapping[str, float]) -> list[Rating]:
    """One rating a joint: the one given, else the model's effort limit if it can be a drive's, else what is needed."""
    least = max(min(LEAST_TORQUE, LOAD_FACTOR * float(need.max())), LEAST_RATING)
    needed = np.maximum(LOAD_FACTOR * need, least).tolist()
    found = []
    for joint, enough, doubt in zip(chain.joints, needed, _effort_doubts(chain, need), strict=True):
        if joint.name in given:
            found.append(Rating(given[joint.name], enough, "given", doubt))
        elif joint.effort is None or doubt:
            found.append(Rating(float(f"{enough:.2g}"), enough, "load", doubt))
        else:
            found.append(Rating(round(joint.effort, 4), enough, "model", doubt))
    return found


def _effort_doubts(chain: Chain, need: Array) -> list[str]:
    """Why a joint's effort limit is no drive's rating, empty where it may be one; `need` (n,) [N·m] is the load's."""
    efforts = [joint.effort for joint in chain.joints]
    stated = {joint: effort for joint, effort in enumerate(efforts) if effort is not None}
    alike = len(stated) > 1 and len(set(stated.values())) == 1
    short = {joint for joint, effort in stated.items() if effort < max(need[joint], LEAST_RATING)}
    everywhere = ""
    if alike and (short or math.log10(min(stated.values())).is_integer()):
        everywhere = f"the model's effort limit of {min(stated.values()):g} N·m for every joint is a placeholder"
    elif stated and min(effort / max(need[joint], 1e-12) for joint, effort in stated.items()) > MOST_RESERVE:
        everywhere = f"the model's effort limits are all more than {MOST_RESERVE:g} times the load"
    doubts = []
    for joint, effort in enumerate(efforts):
        if effort is None:
            doubts.append("the model states no effort limit")
        elif joint in short and not everywhere:
            doubts.append(f"the model's effort limit of {effort:g} N·m is less than the load")
        else:
            doubts.append(everywhere)
    return doubts


def _joint(place: int, chain: Chain, given: tuple[float, float] | None, rating: Rating) -> JointDraft:
    joint, effort = chain.joints[place], rating.torque
    notes = [rating.note] if rating.note else []
    stops = given
    if given is None and not joint.has_stops:
        middle = sum(joint.limits or (0.0, 0.0)) / 2
        stops = (round(middle - ASSUMED_STOP, 4), round(middle + ASSUMED_STOP, 4))
        notes.append(f"stops assumed: {ASSUMED_STOP} rad to either side, since the model has {joint.limits_in_words}")
    elif given is None:
        notes.append("stops assumed to be the limits of the model")
    speed = SPEED if joint.speed is None else min(SPEED, joint.speed)
    if joint.speed is None or joint.speed > SPEED:
        notes.append(f"max_velocity assumed: {SPEED:g} rad/s")
    return JointDraft(
        name=joint.name,
        node=place + 1,
        rated_torque=effort,
        max_torque=effort,
        max_torque_rate=float(f"{effort / RATE_TIME:.3g}"),
        max_velocity=round(speed, 4),
        friction=float(f"{FRICTION * min(effort, rating.needed):.4g}"),
        rotor=0.0 if joint.armature > 0 else float(f"{ROTOR * effort:.2g}"),
        stops=stops,
        notes=notes,
    )


def _load_torque(path: Path, names: Sequence[str], gravity: Sequence[float], locked: Mapping[str, float]) -> Array:
    """Largest torque (n,) [N·m] against gravity and for ACCELERATION of the joint alone, at random poses."""
    import mujoco

    with model_budget(path):
        model = compile_model(path)
    model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    for name, position in locked.items():
        data.joint(name).qpos[:] = position
    joints = [model.joint(name).id for name in names]
    place, dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    free = ~model.jnt_limited[joints].astype(bool)
    low = np.where(free, -np.pi, model.jnt_range[joints, 0])
    high = np.where(free, np.pi, model.jnt_range[joints, 1])
    need, column, unit = np.zeros(len(joints)), np.zeros(model.nv), np.eye(model.nv)[dof]
    for pose in np.random.default_rng(0).uniform(low, high, (200, len(joints))):
        data.qpos[place] = pose
        mujoco.mj_forward(model, data)
        for joint, alone in enumerate(unit):
            mujoco.mj_mulM(model, data, column, alone)
            least = abs(data.qfrc_bias[dof[joint]]) + ACCELERATION * column[dof[joint]]
            need[joint] = max(need[joint], least)
    return need


def assumed_lines(text: str) -> list[int]:
    """Numbers of the lines of an arm file whose comment says that a value is assumed."""
    return [place for place, line in enumerate(text.splitlines(), start=1) if "assumed" in line.partition("#")[2]]


def arm_text(draft: Draft, out: Path) -> str:
    """The YAML text of the draft, to stand at `out`: the model's path is relative to it."""
    lines = [
        yaml_comment(f"{draft.name}: made from {draft.model.name} by `armlink new`."),
        GUESSES,
        yaml_entry("name", draft.name),
        yaml_entry("serial", draft.serial),
        "kinematics:",
        yaml_entry("model", os.path.relpath(draft.model.resolve(), out.resolve().parent), 2),
    ]
    if draft.base is not None:
        lines.append(yaml_entry("base", draft.base, 2))
    if draft.tip is not None:
        lines.append(yaml_entry("tip", draft.tip, 2))
    if draft.locked:
        lines.append("  locked:  # joints that these drives do not move [rad, m]")
        lines += [yaml_entry(name, position, 4) for name, position in draft.locked.items()]
    lines.append(
        yaml_entry("gravity", list(draft.gravity), 2, "m/s² in the model's frame; assumed: mounted as in the model")
    )
    lines += [
        yaml_comment(f"joint {name} {why}, so it is not part of the arm and stays at its position in the model", 2)
        for name, why in draft.aside
        if name not in draft.locked
    ]
    given = {joint.name: list(joint.stops) for joint in draft.joints if joint.stops is not None}
    if given:
        lines.append(f"  stops:  # {'working range' if draft.servo else 'mechanical stops'} [rad]")
        lines += [yaml_entry(name, stops, 4) for name, stops in given.items()]
    simulated = {"interface": SIMULATED, "channel": out.name, "bitrate": 1000000}
    real = "{interface: socketcan, channel: can0}"
    note = f"{NO_BUS}, this is the simulated arm; for a real arm write {real}"
    lines += ["link:", yaml_entry("bus", simulated, 2), yaml_comment(note, 2)]
    lines += [yaml_entry("rate", 250, 2, "Hz, assumed"), "  joints:"]
    keys = ("name", "node", "rated_torque", "max_torque", "max_torque_rate", "max_velocity")
    for joint in draft.joints:
        row = {key: getattr(joint, key) for key in keys}
        lines += [yaml_item(row, 4), *(yaml_comment(note, 6) for note in joint.notes)]
    if draft.servo is not None:
        lines += ["sweep:", yaml_entry("hold", "servo", 2), yaml_comment(f"assumed: {draft.servo}", 2)]
    lines += [
        "sim:  # the simulated arm, for example for `armlink demo`; its masses are the masses of the model",
        f"  effects:  # assumed: friction of {FRICTION:.0%} of the torque that the drives need, and rotor inertias",
    ]
    effects = [("friction.coulomb", joint.name, "torque", joint.friction) for joint in draft.joints]
    effects += [("actuator.rotor_inertia", joint.name, "inertia", joint.rotor) for joint in draft.joints if joint.rotor]
    lines += [yaml_item({"effect": effect, "joint": joint, key: value}, 4) for effect, joint, key, value in effects]
    lines += [yaml_comment(note) for note in draft.notes]
    return "\n".join(lines) + "\n"
