"""The user's own model, moved by MuJoCo along recorded commands: the only simulation of positions.

Integrator, step, solver, contacts and the dynamics of actuators are the model's. Whatever is not between base and tip
is held where it is and touches nothing. Laws that MuJoCo lacks set friction, command and applied torque at each step.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcomp.arm.inertials import body_parameters, point_mass, set_body
from gcomp.arm.model_file import carried_bodies, linear_part
from gcomp.arrays import Array, Mask
from sim_gap.better_model.native_drives import resting_command
from sim_gap.effects.link import tilt_gravity
from sim_gap.model.load import SimModel
from sim_gap.model.solver_friction import creep_speeds, solver_parameters
from sim_gap.position_gap.parameters import PARAMETERS

LOCKED = 1e6
"""Armature of what is held [kg·m² or kg], which is put back after each step: within a step it moves by next to
nothing."""
LOCKED_TOLERANCE = 1e-16
"""Tolerance of MuJoCo's solver beside what is held: it is relative to the inertia of all, and with MuJoCo's usual 1e-8
the arm of two joints in `tests/sim_gap/position_gap/test_plant.py` rests 4 mrad off, with this 0.3 µrad."""
Point = Mapping[str, Array]
"""Parameter → (J,); one of the whole arm has the same value at each joint."""
COARSER = 2.0
"""Time step of a simulation for derivatives, over the model's."""
SPEED_S = 0.01
"""Time over which the derivative of a command is taken [s]."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a recording without a break: commands as they were held from row to row."""

    ends: Array
    """Times at which each command begins, and the last ends [s], (K + 1,)."""
    area: Array
    """Integral of the command up to each of them [rad·s], (K + 1, n)."""
    served: Mask
    """Whether each row is commanded, (K, n)."""
    position: Array
    """Position at the beginning, (n,) [rad]."""
    asked: Array
    """Torque that gravity and springs ask for there, (n,) [N·m]."""
    rests: Mask
    """Whether each joint rests there, (n,)."""

    def command(self, edges: Array, delay: Array, earlier: Array) -> Array:
        """Mean command between the times `edges` (T + 1,), each joint's later by its `delay` (n,) [s]; (T, n).

        `earlier` is the command before the first row, (n,).
        """
        made = [np.interp(edges - late, self.ends, column) for late, column in zip(delay, self.area.T, strict=True)]
        # after the last row the last command holds
        outside = [
            np.minimum(edges - late - self.ends[0], 0.0) * first + np.maximum(edges - late - self.ends[-1], 0.0) * last
            for late, first, last in zip(delay, earlier, self.held[1], strict=True)
        ]
        return np.asarray(np.diff(np.column_stack(made) + np.column_stack(outside), axis=0) / np.diff(edges)[:, None])

    @property
    def held(self) -> tuple[Array, Array]:
        """First and last command, (n,) each."""
        rates = np.diff(self.area, axis=0) / np.diff(self.ends)[:, None]
        return rates[0], rates[-1]

    def served_at(self, times: Array) -> Mask:
        """Whether each joint is commanded at each time, (T, n)."""
        rows = np.searchsorted(self.ends, times + 1e-9, side="right") - 1
        return np.asarray(self.served[np.clip(rows, 0, len(self.served) - 1)])


def servos_of(sim: SimModel) -> tuple[NDArray[np.intp], dict[str, Array]]:
    """Number of the position actuator, PID ones among them, of each joint, or −1, and the parameters of all, (J,) each:
    gains, limits, delays, and time constants of the filters of their commands, as of no servo where there is none."""
    import mujoco

    model: Any = sim.mujoco_model
    actuator, own = np.full(sim.n, -1), {name: np.zeros(sim.n) for name in ("kp", "kv", "ki", "delay", "lag")}
    own |= {name: np.full(sim.n, np.inf) for name in ("limit", "slew")}
    joints = {int(joint): j for j, joint in enumerate(sim.joints)}
    for i in range(model.nu):
        j = joints.get(int(model.actuator_trnid[i, 0]))
        is_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        if j is None or not is_joint or not affine or model.actuator_biasprm[i, 1] >= 0.0:
            continue
        gear = float(model.actuator_gear[i, 0])
        actuator[j] = i
        own["kp"][j], own["kv"][j] = (-model.actuator_biasprm[i, k] * gear**2 for k in (1, 2))
        if model.actuator_forcelimited[i]:
            own["limit"][j] = float(np.abs(model.actuator_forcerange[i]).max()) * abs(gear)
        if model.jnt_actfrclimited[sim.joints[j]]:  # as URDF states it, for all actuators of a joint
            own["limit"][j] = min(own["limit"][j], float(np.abs(model.jnt_actfrcrange[sim.joints[j]]).max()))
        if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_PID:
            own["ki"][j], slew = model.actuator_gainprm[i, 0] * gear**2, float(model.actuator_dynprm[i, 1])
            own["slew"][j] = slew / abs(gear) if slew > 0.0 else np.inf
        own["delay"][j] = model.actuator_delay[i]
        if int(model.actuator_dyntype[i]) in map(int, (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)):
            own["lag"][j] = model.actuator_dynprm[i, 0]
    return actuator, own


def held_model(sim: SimModel) -> Any:
    """A copy of the compiled model in which all but the arm's joints is held and touches nothing."""
    import mujoco

    model = copy(sim.mujoco_model)
    dofs = model.jnt_dofadr[list(sim.joints)]
    others = np.setdiff1d(np.arange(model.nv), dofs)
    moves = carried_bodies(model, model.jnt_bodyid[list(sim.joints)])
    if not len(others):
        return model
    model.dof_armature[others] = LOCKED
    model.opt.tolerance = min(float(model.opt.tolerance), LOCKED_TOLERANCE)
    for i in range(model.nu):
        joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        if not joint or int(model.actuator_trnid[i, 0]) not in sim.joints:
            model.actuator_gainprm[i], model.actuator_biasprm[i] = 0.0, 0.0
    outside = ~np.isin(model.geom_bodyid, moves)
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

    def __init__(self, sim: SimModel, steps: float = 1.0) -> None:
        """`steps` is the time step over that of the model."""
        import mujoco

        self.sim, (self.actuator, self.servo) = sim, servos_of(sim)
        self.model = held_model(sim)
        self.model.opt.timestep *= steps
        joints = list(sim.joints)
        self.joints, self.n, self.dt = joints, sim.n, float(self.model.opt.timestep)
        self.dofs, self.places = self.model.jnt_dofadr[joints], self.model.jnt_qposadr[joints]
        self.bodies = self.model.jnt_bodyid[joints]
        self.held = HeldParts.of(self.model, joints)
        self._widen_ranges()
        self.driven = self.actuator >= 0
        self.controls = self.model.actuator_ctrladr[self.actuator[self.driven]]
        self.gear = np.ones(sim.n)
        self.gear[self.driven] = self.model.actuator_gear[self.actuator[self.driven], 0]
        self.pid = np.zeros(sim.n, bool)
        drives = self.actuator[self.driven]
        self.pid[self.driven] = self.model.actuator_dyntype[drives] == mujoco.mjtDyn.mjDYN_PID
        self.creep = creep_speeds(self.model, self.dofs)
        shares = self.model.body_gravcomp[self.carried()]
        self.compensated = float(shares[0]) if np.ptp(shares) < 1e-9 else 0.0
        """Share of gravity that the model compensates, where it is the same for all bodies of the arm."""
        self.state = mujoco.MjData(self.model)
        self._states: list[Any] = []

    @cached_property
    def coarser(self) -> "MovedModel":
        """The same with a longer time step, for derivatives."""
        return MovedModel(self.sim, COARSER)

    def states(self, count: int) -> list[Any]:
        """States to be stepped together; the same ones at each call."""
        import mujoco

        while len(self._states) < count:
            self._states.append(mujoco.MjData(self.model))
        return self._states[:count]

    def _widen_ranges(self) -> None:
        """Where the arm was seen beyond its range, the model may go there too."""
        model, ranges = self.model, self.sim.arm.range
        for j, joint in enumerate(self.joints):
            if model.jnt_limited[joint]:
                wider = (ranges[j, 0] < model.jnt_range[joint, 0]) | (ranges[j, 1] > model.jnt_range[joint, 1])
                i = self.actuator[j]
                model.jnt_range[joint] = ranges[j]
                if wider and i >= 0 and model.actuator_ctrllimited[i]:
                    gear = float(model.actuator_gear[i, 0])
                    ends = np.sort(ranges[j] * gear)
                    own = model.actuator_ctrlrange[i]
                    model.actuator_ctrlrange[i] = min(own[0], ends[0]), max(own[1], ends[1])

    # ---- the model with other parameters

    def changed(self, point: Point) -> Any:
        """A copy of the model with parameters (J,)."""
        model, own = copy(self.model), self.servo
        brake = np.minimum(point["kv"], point["viscous"])
        inner = brake + point["back_emf"] + point["kd"] * point["gain"]
        stiff = point["kp"] * point["gain"]
        damping, stiffness = linear_part(model.dof_damping, model.nv), linear_part(model.jnt_stiffness, model.njnt)
        for j in range(self.n):
            joint, dof, i = self.joints[j], self.dofs[j], self.actuator[j]
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
                    model.actuator_dynprm[i, 1] = point["slew"][j] * abs(gear) if own["slew"][j] < np.inf else 0.0
                else:
                    model.actuator_gainprm[i, 0] = stiff[j] / gear**2
                if own["lag"][j] > 0.0:
                    model.actuator_dynprm[i, 0] = max(point["lag"][j], self.dt)
                limit = point["limit"][j] * point["gain"][j]
                if np.isfinite(limit) and (limit != own["limit"][j]):
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
        return carried_bodies(self.model, self.bodies)

    def _change_links(self, model: Any, point: Point) -> None:
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
                body, anchor = int(self.bodies[link]), self.model.jnt_pos[self.joints[link]]
                set_body(model, body, anchor, body_parameters(self.model, body, anchor, np.eye(3)) + change)

    # ---- commands

    def earlier_command(self, piece: Piece, point: Point, scale: float) -> Array:
        """Command before a piece, (J,) [rad]: its first, or of a joint that rests the nearest under which it stays."""
        asked = np.where(point["ki"] > 0.0, 0.0, piece.asked * (1.0 - point["feed"]) + point["offset"])
        stiffness = np.maximum(point["kp"] * point["gain"] * scale, 1e-9)
        friction = point["coulomb"] + point["stribeck"] + point["load"] * np.abs(asked) + point["dead"] * stiffness
        first, _ = piece.held
        return np.where(piece.rests, resting_command(first, piece.position, asked, friction, stiffness), first)

    def commands(self, piece: Piece, begin: float, steps: int, point: Point, scale: float, earlier: Array) -> Array:
        """Input of each servo at each step of a window, (steps, J) [rad]; `earlier` is that before the piece."""
        late = point["delay"] - self.servo["delay"]
        edges: Array = begin + self.dt * np.arange(steps + 1, dtype=float)
        given = piece.command(edges, late, earlier)
        most = np.where(self.pid & np.isfinite(self.servo["slew"]), np.inf, point["slew"]) * self.dt
        if np.isfinite(most).any():
            given = follow(given, earlier if begin == 0.0 else given[0], most)
        ahead = point["kd"] / np.maximum(point["kp"] * scale, 1e-9)
        if np.any(ahead):
            wide = max(1, round(SPEED_S / self.dt))
            speed = np.subtract(*(piece.command(edges + side * SPEED_S, late, earlier) for side in (1.0, -1.0)))
            given = given + ahead * speed / (2.0 * wide * self.dt)
        return given


def follow(given: Array, before: Array, most: Array) -> Array:
    """A command (T, n) that changes by at most `most` from step to step, from `before` on, (n,) each."""
    out = given.copy()
    for j in np.flatnonzero(np.isfinite(most)).tolist():
        command, step, last = given[:, j], float(most[j]), float(before[j])
        edges = np.concatenate([[0], np.flatnonzero(np.diff(command)) + 1, [len(command)]])
        goals, counts = command[edges[:-1]], np.diff(edges)  # the command stays between them
        reached = [last]
        for goal, way in zip(goals.tolist(), (step * counts).tolist(), strict=True):
            last = min(max(goal, last - way), last + way)
            reached.append(last)
        away = np.repeat(np.array(reached[:-1]) - goals, counts)
        left = np.abs(away) - step * (np.arange(len(command)) - np.repeat(edges[:-1], counts) + 1.0)
        out[:, j] += np.copysign(np.maximum(left, 0.0), away)
    return out


def nominal_point(plant: MovedModel) -> dict[str, Array]:
    """Parameters of the nominal model at every joint, neutral where it says nothing."""
    arm, one = plant.sim.arm, np.ones(plant.n)
    point = {name: p.neutral * one for name, p in PARAMETERS.items()} | {n: x.copy() for n, x in plant.servo.items()}
    point["kp"] = np.where(plant.driven, point["kp"], 1.0)
    point |= {"coulomb": arm.frictionloss.copy(), "armature": arm.armature.copy(), "viscous": arm.damping + point["kv"]}
    point["spring"], point["offset"] = arm.stiffness.copy(), -arm.stiffness * arm.rest
    return point | {"creep": plant.creep.copy(), "feed": plant.compensated * one}
