"""The user's own model, moved by MuJoCo along recorded commands: the only simulation of positions.

Integrator, step, solver, contacts and the dynamics of actuators are the model's. Whatever is not between base and tip
is held where it is and touches nothing. Laws that MuJoCo lacks set friction, command and applied torque at each step.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcomp.arrays import Array
from sim_gap.better_model.corrected_model import (
    body_parameters,
    closest_possible,
    mass_centre_inertia,
    mujoco_quaternion,
)
from sim_gap.better_model.native_drives import hold
from sim_gap.effects.base import tilt_gravity
from sim_gap.effects.link import point_mass
from sim_gap.model.load import SimModel, linear_part
from sim_gap.model.solver_friction import creep_speeds, solver_parameters
from sim_gap.position_gap.windows import Piece, Windows

LOCKED = 1e6
"""Armature of what is held [kg·m² or kg], which is put back after each step: within a step it moves by next to
nothing."""
LOCKED_TOLERANCE = 1e-16
"""Tolerance of MuJoCo's solver beside what is held: it is relative to the inertia of all, and with MuJoCo's usual 1e-8
the arm of two joints in `tests/sim_gap/position_gap/test_plant.py` rests 4 mrad off, with this 0.3 µrad."""
Values = Mapping[str, Array]
"""Parameter → (P, J) of P hypotheses; one of the whole arm has the same value at each joint."""
SPEED_S = 0.01
"""Time over which the derivative of a command is taken [s]."""
WORLDS = 64
"""Simulations that are stepped together where laws are evaluated at each step."""


@dataclass(frozen=True, eq=False)
class Servos:
    """Controller of the model's own position actuators, (J,) each; NaN gains at a joint without one."""

    actuator: NDArray[np.intp]
    """Number of each joint's actuator, or −1."""
    kp: Array
    kv: Array
    ki: Array
    limit: Array
    slew: Array
    delay: Array

    @property
    def complete(self) -> bool:
        return bool(np.isfinite(self.kp).all())


def servos_of(sim: SimModel) -> Servos:
    """Gains, limits and delays of the model's position actuators, PID ones among them."""
    import mujoco

    model: Any = sim.mujoco_model
    n = sim.n
    zero, none = np.zeros(n), np.full(n, np.inf)
    own = Servos(np.full(n, -1), np.full(n, np.nan), zero.copy(), zero.copy(), none.copy(), none.copy(), zero.copy())
    joints = {int(joint): j for j, joint in enumerate(sim.joints)}
    for i in range(model.nu):
        j = joints.get(int(model.actuator_trnid[i, 0]))
        is_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        if j is None or not is_joint or not affine or model.actuator_biasprm[i, 1] >= 0.0:
            continue
        gear = float(model.actuator_gear[i, 0])
        own.actuator[j] = i
        own.kp[j], own.kv[j] = -model.actuator_biasprm[i, 1] * gear**2, -model.actuator_biasprm[i, 2] * gear**2
        if model.actuator_forcelimited[i]:
            own.limit[j] = float(np.abs(model.actuator_forcerange[i]).max()) * abs(gear)
        if model.jnt_actfrclimited[sim.joints[j]]:  # as URDF states it, for all actuators of a joint
            own.limit[j] = min(own.limit[j], float(np.abs(model.jnt_actfrcrange[sim.joints[j]]).max()))
        if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_PID:
            own.ki[j], slew = model.actuator_gainprm[i, 0] * gear**2, float(model.actuator_dynprm[i, 1])
            own.slew[j] = slew / abs(gear) if slew > 0.0 else np.inf
        own.delay[j] = model.actuator_delay[i]
    return own


def held_model(sim: SimModel) -> Any:
    """A copy of the compiled model in which all but the arm's joints is held and touches nothing."""
    import mujoco

    model = copy(sim.mujoco_model)
    dofs = model.jnt_dofadr[list(sim.joints)]
    others = np.setdiff1d(np.arange(model.nv), dofs)
    moves = {int(model.jnt_bodyid[joint]) for joint in sim.joints}
    for body in range(1, model.nbody):
        if int(model.body_parentid[body]) in moves:
            moves.add(body)
    if not len(others):
        return model
    model.dof_armature[others] = LOCKED
    model.opt.tolerance = min(float(model.opt.tolerance), LOCKED_TOLERANCE)
    for i in range(model.nu):
        joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        if not joint or int(model.actuator_trnid[i, 0]) not in sim.joints:
            model.actuator_gainprm[i], model.actuator_biasprm[i] = 0.0, 0.0
    outside = ~np.isin(model.geom_bodyid, sorted(moves))
    model.geom_contype[outside], model.geom_conaffinity[outside] = 0, 0
    refresh(model)
    return model


def refresh(model: Any) -> None:
    """Let a model that was changed have the constants that follow from its fields, by its moving parts alone.

    The solver stops at a residual that is small beside the mean inertia, which must not be that of what is held.
    """
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    moving = model.dof_armature < LOCKED
    if not moving.all():
        model.stat.meaninertia = max(float(np.mean(model.dof_M0[moving])), 1e-10)


@dataclass(frozen=True, eq=False)
class HeldParts:
    """Places and degrees of freedom that are put back after each step."""

    places: NDArray[np.intp]
    dofs: NDArray[np.intp]
    at: Array

    @classmethod
    def of(cls, model: Any, joints: Sequence[int]) -> "HeldParts":
        arm = [int(model.jnt_qposadr[j]) for j in joints], [int(model.jnt_dofadr[j]) for j in joints]
        places, dofs = (
            np.setdiff1d(np.arange(count), own) for count, own in zip((model.nq, model.nv), arm, strict=True)
        )
        return cls(places.astype(np.intp), dofs.astype(np.intp), model.qpos0[places].copy())

    def put_back(self, state: Any) -> None:
        state.qpos[self.places], state.qvel[self.dofs] = self.at, 0.0


def held_parts(sim: SimModel) -> list[str]:
    """Names of bodies outside of the arm that could move by themselves and are held, the first ones that do."""
    model = sim.mujoco_model
    joints = [j for j in range(model.njnt) if j not in sim.joints]
    return list(dict.fromkeys(str(model.body(int(model.jnt_bodyid[j])).name or "a body") for j in joints))


class MovedModel:
    """The model with parameters of joints, servos and links to be changed."""

    def __init__(self, sim: SimModel) -> None:
        import mujoco

        self.sim, self.servos = sim, servos_of(sim)
        self.model = held_model(sim)
        joints = list(sim.joints)
        self.joints, self.n, self.dt = joints, sim.n, float(self.model.opt.timestep)
        self.dofs, self.places = self.model.jnt_dofadr[joints], self.model.jnt_qposadr[joints]
        self.bodies = self.model.jnt_bodyid[joints]
        self.held = HeldParts.of(self.model, joints)
        self._widen_ranges()
        self.driven = self.servos.actuator >= 0
        self.controls = self.model.actuator_ctrladr[self.servos.actuator[self.driven]]
        self.gear = np.ones(sim.n)
        self.gear[self.driven] = self.model.actuator_gear[self.servos.actuator[self.driven], 0]
        self.pid = np.zeros(sim.n, bool)
        drives = self.servos.actuator[self.driven]
        self.pid[self.driven] = self.model.actuator_dyntype[drives] == mujoco.mjtDyn.mjDYN_PID
        self.creep = creep_speeds(self.model, self.dofs)
        shares = self.model.body_gravcomp[self.carried()]
        self.compensated = float(shares[0]) if np.ptp(shares) < 1e-9 else 0.0
        """Share of gravity that the model compensates, where it is the same for all bodies of the arm."""
        self.state = mujoco.MjData(self.model)

    def _widen_ranges(self) -> None:
        """Where the arm was seen beyond its range, the model may go there too."""
        model, ranges = self.model, self.sim.arm.range
        for j, joint in enumerate(self.joints):
            if model.jnt_limited[joint]:
                wider = (ranges[j, 0] < model.jnt_range[joint, 0]) | (ranges[j, 1] > model.jnt_range[joint, 1])
                i = self.servos.actuator[j]
                model.jnt_range[joint] = ranges[j]
                if wider and i >= 0 and model.actuator_ctrllimited[i]:
                    gear = float(model.actuator_gear[i, 0])
                    ends = np.sort(ranges[j] * gear)
                    own = model.actuator_ctrlrange[i]
                    model.actuator_ctrlrange[i] = min(own[0], ends[0]), max(own[1], ends[1])

    # ---- the model with other parameters

    def changed(self, point: Mapping[str, Array]) -> Any:
        """A copy of the model with parameters (J,)."""
        model, own = copy(self.model), self.servos
        brake = np.minimum(point["kv"], point["viscous"])
        inner = brake + point["back_emf"] + point["kd"] * point["gain"]
        stiff = point["kp"] * point["gain"]
        damping, stiffness = linear_part(model.dof_damping, model.nv), linear_part(model.jnt_stiffness, model.njnt)
        for j in range(self.n):
            joint, dof, i = self.joints[j], self.dofs[j], self.servos.actuator[j]
            damping[dof] = point["viscous"][j] - brake[j] + (0.0 if self.driven[j] else inner[j])
            stiffness[joint] = point["spring"][j] + (0.0 if self.driven[j] else stiff[j])
            model.qpos_spring[self.places[j]] = 0.0
            model.dof_frictionloss[dof] = point["coulomb"][j]
            model.dof_armature[dof] = point["armature"][j]
            if self.driven[j]:
                gear = self.gear[j]
                model.actuator_biasprm[i, 1], model.actuator_biasprm[i, 2] = -stiff[j] / gear**2, -inner[j] / gear**2
                if self.pid[j]:
                    model.actuator_gainprm[i, 0] = point["ki"][j] * point["gain"][j] / gear**2
                    model.actuator_dynprm[i, 1] = point["slew"][j] * abs(gear) if own.slew[j] < np.inf else 0.0
                else:
                    model.actuator_gainprm[i, 0] = stiff[j] / gear**2
                limit = point["limit"][j] * point["gain"][j]
                if np.isfinite(limit) and (limit != own.limit[j]):
                    model.actuator_forcelimited[i] = 1
                    model.actuator_forcerange[i] = np.array([-limit, limit]) / abs(gear)
                    model.jnt_actfrcrange[joint] = np.maximum(np.abs(model.jnt_actfrcrange[joint]), limit) * [-1, 1]
        self._change_links(model, point)
        angles = [float(point[name][0]) if name in point else 0.0 for name in ("tilt.angle_1", "tilt.angle_2")]
        if any(angles):
            model.opt.gravity[:] = tilt_gravity(self.sim.arm.gravity, np.array(angles))
        if np.any(
            point["feed"] != self.compensated
        ):  # gravity's torque is made for all, and each joint takes its share
            model.body_gravcomp[self.carried()] = 1.0
        refresh(model)
        for j, dof in enumerate(self.dofs):
            if point["creep"][j] != self.creep[j]:
                level = float(point["coulomb"][j] + point["stribeck"][j])
                values = solver_parameters(level, float(point["creep"][j]), float(model.dof_invweight0[dof]))
                model.dof_solref[dof], model.dof_solimp[dof] = values
        return model

    def carried(self) -> list[int]:
        """Bodies that the arm's joints carry."""
        up, out = self.model.body_parentid, set(self.bodies.tolist())
        for body in range(1, self.model.nbody):
            if int(up[body]) in out:
                out.add(body)
        return sorted(out)

    def _change_links(self, model: Any, point: Mapping[str, Array]) -> None:
        for link in range(self.n):
            angle = float(point[f"zero{link}.angle"][0]) if f"zero{link}.angle" in point else 0.0
            model.qpos0[self.places[link]] -= angle
            change = np.zeros(10)
            if f"moment{link}.x" in point or f"moment{link}.y" in point or f"moment{link}.z" in point:
                change[1:4] = [float(point.get(f"moment{link}.{axis}", np.zeros(1))[0]) for axis in "xyz"]
            if link == self.n - 1 and "payload.mass" in point:
                mass, *moment = (
                    float(point[f"payload.{k}"][0]) if f"payload.{k}" in point else 0.0 for k in ("mass", "x", "y", "z")
                )
                change += point_mass(mass, np.array(moment))
            if change.any():
                self._set_body(model, link, change)

    def _set_body(self, model: Any, link: int, change: Array) -> None:
        body, anchor = int(self.bodies[link]), self.model.jnt_pos[self.joints[link]]
        mass, centre, about = mass_centre_inertia(body_parameters(self.model, body, anchor, np.eye(3)) + change)
        values, axes = np.linalg.eigh(about)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        model.body_mass[body], model.body_ipos[body] = mass, anchor + centre
        model.body_inertia[body] = closest_possible(values)
        mujoco_quaternion(model.body_iquat[body], axes)

    # ---- commands

    def commands(self, piece: Piece, begin: float, steps: int, point: Mapping[str, Array], scale: float) -> Array:
        """Input of each servo at each step of a window, (steps, J) [rad]."""
        late = point["delay"] - self.servos.delay
        edges: Array = begin + self.dt * np.arange(steps + 1, dtype=float)
        given = piece.command(edges, late)
        most = np.where(self.pid & np.isfinite(self.servos.slew), np.inf, point["slew"]) * self.dt
        if np.isfinite(most).any():
            for k in range(1, steps):
                given[k] = given[k - 1] + np.clip(given[k] - given[k - 1], -most, most)
        ahead = point["kd"] / np.maximum(point["kp"] * scale, 1e-9)
        if np.any(ahead):
            wide = max(1, round(SPEED_S / self.dt))
            speed = piece.command(edges + SPEED_S, late) - piece.command(edges - SPEED_S, late)
            given = given + ahead * speed / (2.0 * wide * self.dt)
        return given


def laws_of(point: Mapping[str, Array], plant: MovedModel) -> set[str]:
    """Names of the parameters of a point that act by a law at each step."""
    found = {name for name in ("dead", "stribeck", "load") if np.any(point[name] != 0.0)}
    if np.any(point["feed"] != plant.compensated):
        found.add("feed")
    if np.any((point["ki"] > 0.0) & ~plant.pid):
        found.add("ki")
    if np.any(np.isfinite(point["limit"]) & ~plant.driven):
        found.add("limit")
    return found


@contextmanager
def silent() -> Iterator[None]:
    """MuJoCo writes no log of the simulations that break loose."""
    import mujoco

    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def simulate(data: Windows, values: Values) -> Array:
    """Positions at the times of comparison for P hypotheses [rad], (P, To, J, W)."""
    count = max(len(x) for x in values.values())
    out = np.empty((count, *data.measured.shape))
    with silent():
        for p in range(count):
            point = {name: x[p if len(x) > 1 else 0] for name, x in values.items()}
            out[p] = _moved(data.plant, data, point)
    return out


def _moved(plant: MovedModel, data: Windows, point: Mapping[str, Array]) -> Array:
    """Positions of one hypothesis, (To, J, W)."""
    laws = laws_of(point, plant)
    models = {
        float(scale): plant.changed({**point, **{name: point[name] * scale for name in ("kp", "kd", "ki")}})
        for scale in np.unique(data.scale)
    }
    worlds = [World(plant, models[float(data.scale[w])], data, w, point) for w in range(data.count)]
    by_law = [bool(laws) or not world.served.all() for world in worlds]
    out = np.empty_like(data.measured)
    for world, lawful in zip(worlds, by_law, strict=True):
        if not lawful:
            world.run()
    together = [world for world, lawful in zip(worlds, by_law, strict=True) if lawful]
    for first in range(0, len(together), WORLDS):
        run_with_laws(plant, together[first : first + WORLDS], point, laws)
    for w, world in enumerate(worlds):
        out[..., w] = world.positions()
    return out


class World:
    """One window of one hypothesis."""

    def __init__(self, plant: MovedModel, model: Any, data: Windows, w: int, point: Mapping[str, Array]) -> None:
        self.plant, self.model, self.data, self.w, self.point = plant, model, data, w, point
        self.piece, self.scale, self.at = data.pieces[data.piece[w]], float(data.scale[w]), data.at[:, w]
        self.steps = int(np.ceil(self.at.max() / plant.dt - 1e-6)) + 1
        self.given = plant.commands(self.piece, float(data.begin[w]), self.steps, point, self.scale)
        self.served = self.piece.served_at(data.begin[w] + plant.dt * np.arange(self.steps))
        self.track = np.empty((self.steps + 1, plant.n))
        self.applied = -point["offset"] - point["asymmetry"] * point["coulomb"]
        """Torques that do not change [N·m], (J,)."""

    def run(self) -> None:
        """Move the model without a law."""
        import mujoco

        plant, model = self.plant, self.model
        d = plant.state
        self.begin(model, d)
        spring = np.where(plant.driven, 0.0, self.point["kp"] * self.point["gain"] * self.scale)
        loose, held = not plant.driven.all(), bool(plant.held.places.size)
        given = self.given[:, plant.driven] * plant.gear[plant.driven]
        for first, last in pairwise(self._edges()):  # between them the command does not change
            self.track[first] = d.qpos[plant.places]
            d.ctrl[plant.controls] = given[first]
            if loose:
                d.qfrc_applied[plant.dofs] = self.applied + spring * self.given[first]
            if not held:
                mujoco.mj_step(model, d, last - first)
                continue
            for _ in range(last - first):
                mujoco.mj_step(model, d)
                plant.held.put_back(d)
        self.track[self.steps] = d.qpos[plant.places]

    def _edges(self) -> list[int]:
        """Steps at which a command changes or a position is read, the first, and the end."""
        changes = np.flatnonzero(np.any(np.diff(self.given, axis=0) != 0.0, axis=1)) + 1
        whole = self._steps_of_comparison()[0]
        return sorted({0, self.steps, *changes.tolist(), *whole.tolist(), *(whole + 1).tolist()})

    def _steps_of_comparison(self) -> tuple[NDArray[np.intp], Array]:
        """Step before each time of comparison, and the share of a step that it is later, (To,) each."""
        steps = self.at / self.plant.dt
        whole = np.minimum((steps + 1e-6).astype(int), self.steps - 1)
        return whole, np.maximum(steps - whole, 0.0)

    def positions(self) -> Array:
        """Positions at the times of comparison, (To, J)."""
        whole, late = self._steps_of_comparison()
        share = late[:, None]
        return np.asarray(self.track[whole] * (1.0 - share) + self.track[whole + 1] * share)

    def begin(self, model: Any, d: Any) -> None:
        """The recorded state; actuators as if the command had been there for long, an integral part with what gathered
        since the start."""
        import mujoco

        plant, data, w = self.plant, self.data, self.w
        mujoco.mj_resetData(model, d)
        drives = plant.servos.actuator[plant.driven].tolist()
        if len(drives) and model.na + int(model.actuator_history[drives, 0].sum()):
            d.qpos[plant.places] = data.first[:, w]
            first = self.piece.held[0] if data.begin[w] > 0.0 else self.given[0]
            hold(model, d, drives, (first * plant.gear)[plant.driven])
            for i, j in zip(drives, np.flatnonzero(plant.driven).tolist(), strict=True):
                count, place = int(model.actuator_history[i, 0]), int(model.actuator_actadr[i])
                now = self.given[0, j] * plant.gear[j]
                if count:
                    mujoco.mj_initCtrlHistory(model, d, i, None, np.full((count, 1), now))
                if plant.pid[j]:
                    if model.actuator_dynprm[i, 1] > 0.0:
                        d.act[place] = now
                    if model.actuator_gainprm[i, 0] > 0.0:
                        d.act[place + int(model.actuator_actnum[i]) - 1] += data.error_sum[j, w] * plant.gear[j]
                elif model.actuator_actnum[i]:
                    d.act[place] = now
        d.qpos[plant.places], d.qvel[plant.dofs] = data.start[:, :, w]
        d.qfrc_applied[plant.dofs] = self.applied

    def integral(self) -> Array:
        """Integral of the error of servos whose integral part is a law, (J,): what holds at first and what came."""
        ki = np.maximum(self.point["ki"], 1e-9)
        q = self.data.first[:, self.w]
        error = self.piece.held[0] - q
        asked = self.plant.sim.arm.torque(q[None], 0 * q[None], 0 * q[None])[0]
        return np.asarray((asked / self.point["gain"] - self.point["kp"] * error) / ki + self.data.error_sum[:, self.w])


def run_with_laws(
    plant: MovedModel, worlds: Sequence[World], point: Mapping[str, Array], laws: Collection[str]
) -> None:
    """Move some worlds together, and evaluate the laws at each step for all of them at once, (W, n)."""
    import mujoco

    dofs, places, drives, dt = plant.dofs, plant.places, plant.servos.actuator[plant.driven], plant.dt
    friction, held = bool({"stribeck", "load"} & {*laws}), bool(plant.held.places.size)
    switched = [not world.served.all() for world in worlds]
    models = [copy(w.model) if friction or off else w.model for w, off in zip(worlds, switched, strict=True)]
    states = [mujoco.MjData(model) for model in models]
    for world, model, d in zip(worlds, models, states, strict=True):
        world.begin(model, d)
    scale = np.array([world.scale for world in worlds])[:, None]
    inner = np.minimum(point["kv"], point["viscous"]) + point["back_emf"] + point["kd"] * point["gain"]
    kp, ki = point["kp"] * point["gain"] * scale, point["ki"] * scale * ~plant.pid
    loose, gear = ~plant.driven, plant.gear
    total = np.stack([world.integral() for world in worlds]) if "ki" in laws else np.zeros((len(worlds), plant.n))
    carried, longest = np.zeros((len(worlds), plant.n)), max(world.steps for world in worlds)

    def whole(rows: Sequence[Array], steps: int) -> Array:
        return np.stack([np.concatenate([x, np.repeat(x[-1:], steps - len(x), axis=0)]) for x in rows], axis=1)

    given = whole([world.given for world in worlds], longest)
    served = whole([world.served for world in worlds], longest)
    applied = worlds[0].applied
    tracks = np.empty((longest + 1, len(worlds), plant.n))

    views = {name: [getattr(d, name) for d in states] for name in _READ}
    dampings = [linear_part(model.dof_damping, model.nv) for model in models]
    springs = [linear_part(model.jnt_stiffness, model.njnt) for model in models]
    kept = [(m.actuator_gainprm[drives].copy(), m.actuator_biasprm[drives].copy()) for m in models]
    outer = [damping[dofs] - np.where(plant.driven, 0.0, inner) for damping in dampings]

    def now(name: str, at: Array) -> Array:
        return np.concatenate(views[name]).reshape(len(states), -1)[:, at]

    for k in range(longest):
        q, v, on, c = now("qpos", places), now("qvel", dofs), served[k], given[k]
        tracks[k] = q
        for w in np.flatnonzero(switched).tolist() if k == 0 or np.any(on != served[k - 1]) else ():
            model, drive = models[w], on[w][plant.driven][:, None]
            model.actuator_gainprm[drives], model.actuator_biasprm[drives] = kept[w][0] * drive, kept[w][1] * drive
            dampings[w][dofs] = outer[w] + np.where(loose & on[w], inner, 0.0)
            springs[w][plant.joints] = point["spring"] + np.where(loose & on[w], kp[w], 0.0)
        if "dead" in laws:
            c = c - np.minimum(np.maximum(c - q, -point["dead"]), point["dead"])
        torque = np.zeros_like(q) + applied
        if "ki" in laws:
            total += dt * on * (c - q)
            torque += ki * total * on
        if loose.any():
            pushed = kp * c
            if "limit" in laws:
                wish = kp * (c - q) - inner * v
                pushed = pushed + np.clip(wish, -point["limit"], point["limit"]) - wish
            torque += loose * on * pushed
        if "feed" in laws:
            torque += (point["feed"] * on - 1.0) * now("qfrc_gravcomp", dofs)
        if friction:
            level = point["coulomb"] + point["stribeck"] * np.exp(-((v / point["stribeck_velocity"]) ** 2))
            level = level + point["load"] * np.abs(carried)
            for model, each in zip(models, level, strict=True):
                model.dof_frictionloss[dofs] = each
        controls = (c * gear)[:, plant.driven]
        for model, d, push, control in zip(models, states, torque, controls, strict=True):
            d.qfrc_applied[dofs] = push
            d.ctrl[plant.controls] = control
            mujoco.mj_step(model, d)
            if held:
                plant.held.put_back(d)
        if "load" in laws:
            carried = sum(now(name, dofs) for name in _READ[2:6]) - point["armature"] * now("qacc", dofs)
    tracks[longest] = now("qpos", places)
    for w, world in enumerate(worlds):
        world.track = tracks[: world.steps + 1, w]


_READ = ("qpos", "qvel", "qfrc_applied", "qfrc_actuator", "qfrc_passive", "qfrc_constraint", "qacc", "qfrc_gravcomp")


def nominal_point(plant: MovedModel, neutral: Mapping[str, float]) -> dict[str, Array]:
    """Parameters of the nominal model at every joint, neutral where it says nothing."""
    arm, own, one = plant.sim.arm, plant.servos, np.ones(plant.n)
    point = {name: value * one for name, value in neutral.items()}
    point |= {"coulomb": arm.frictionloss.copy(), "armature": arm.armature.copy()}
    point["viscous"] = arm.damping + np.where(np.isfinite(own.kp), own.kv, 0.0)
    point["kp"] = np.where(np.isfinite(own.kp), own.kp, 1.0)
    point["kv"] = np.where(np.isfinite(own.kp), own.kv, 0.0)
    point |= {"ki": own.ki.copy(), "limit": own.limit.copy(), "slew": own.slew.copy(), "delay": own.delay.copy()}
    point["spring"], point["offset"] = arm.stiffness.copy(), -arm.stiffness * arm.rest
    return point | {"creep": plant.creep.copy(), "feed": plant.compensated * one}
