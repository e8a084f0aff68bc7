"""Windows of recorded motion, simulated from the parameters of a hypothesis; laws that MuJoCo lacks at each step."""

from collections.abc import Sequence
from copy import copy
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcomp.arm.model_file import linear_part
from gcomp.arrays import Array
from sim_gap.better_model.native_drives import hold
from sim_gap.model.load import silent
from sim_gap.position_gap.plant import MovedModel, Point
from sim_gap.position_gap.windows import Windows

WORLDS = 32
"""Simulations that are stepped together where laws are evaluated at each step: with more their states leave the
processor's cache, with fewer the laws cost as much as the steps."""

SAME_RAD = 1e-9
"""Difference of two commands that rounding makes [rad]."""


def simulate(data: Windows, points: Sequence[Point]) -> Array:
    """Positions at the times of comparison for P hypotheses [rad], (P, To, J, W)."""
    out = np.empty((len(points), *data.measured.shape))
    lawful: list[tuple[int, World]] = []

    def run(least: int) -> None:
        while len(lawful) > least:
            together = lawful[:WORLDS]
            del lawful[:WORLDS]
            run_with_laws([world for _, world in together])
            for p, world in together:
                out[p, ..., world.w] = world.positions()

    with silent():
        for p, point in enumerate(points):
            for world in _worlds(data, point):
                if world.laws or not world.served.all():
                    lawful.append((p, world))
                else:
                    world.run()
                    out[p, ..., world.w] = world.positions()
            run(WORLDS)
        run(0)
    return out


def _worlds(data: Windows, point: Point) -> "list[World]":
    """The windows of one hypothesis."""
    models = {
        float(scale): data.plant.changed({**point, **{name: point[name] * scale for name in ("kp", "kd", "ki")}})
        for scale in np.unique(data.scale)
    }
    return [World(models[float(data.scale[w])], data, w, point) for w in range(data.count)]


class World:
    """One window of one hypothesis."""

    def __init__(self, model: Any, data: Windows, w: int, point: Point) -> None:
        self.plant, self.model, self.data, self.w, self.point = (plant := data.plant), model, data, w, point
        self.piece, self.scale, self.at = data.pieces[data.piece[w]], float(data.scale[w]), data.at[:, w]
        self.steps = int(np.ceil(self.at.max() / plant.dt - 1e-6)) + 1
        self.earlier = plant.earlier_command(self.piece, point, self.scale)
        self.given = plant.commands(self.piece, float(data.begin[w]), self.steps, point, self.scale, self.earlier)
        self.served = self.piece.served_at(data.begin[w] + plant.dt * np.arange(self.steps))
        self.track = np.empty((self.steps + 1, plant.n))
        self.laws = laws_of(point, plant)
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
        position, control, places, controls = d.qpos, d.ctrl, _slice_of(plant.places), _slice_of(plant.controls)
        for first, last in pairwise(self._edges()):  # between them the command does not change
            self.track[first] = position[places]
            control[controls] = given[first]
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
        changes = np.flatnonzero(np.any(np.abs(np.diff(self.given, axis=0)) > SAME_RAD, axis=1)) + 1
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
        """The recorded state; actuators as if the command before had been there for long, an integral part with what
        gathered since the start."""
        import mujoco

        plant, data, w = self.plant, self.data, self.w
        mujoco.mj_resetData(model, d)
        drives = plant.actuator[plant.driven].tolist()
        if len(drives) and model.na + int(model.actuator_history[drives, 0].sum()):
            d.qpos[plant.places] = data.first[:, w]
            before = self.given[0] if data.begin[w] > 0.0 else self.earlier
            hold(model, d, drives, (self.earlier * plant.gear)[plant.driven])
            for i, j in zip(drives, np.flatnonzero(plant.driven).tolist(), strict=True):
                count, place = int(model.actuator_history[i, 0]), int(model.actuator_actadr[i])
                now = before[j] * plant.gear[j]
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
        error = self.earlier - q
        asked = self.plant.sim.arm.gravity_torque(q[None])[0]
        return np.asarray((asked / self.point["gain"] - self.point["kp"] * error) / ki + self.data.error_sum[:, self.w])


def run_with_laws(worlds: Sequence[World]) -> None:
    """Move some worlds together, and evaluate the laws at each step for all of them at once, (W, n)."""
    import mujoco

    plant = worlds[0].plant
    dofs, places, drives, dt = plant.dofs, plant.places, plant.actuator[plant.driven], plant.dt
    laws = {law for world in worlds for law in world.laws}
    point = {name: np.stack([world.point[name] for world in worlds]) for name in worlds[0].point}
    friction, held = bool({"stribeck", "load"} & {*laws}), bool(plant.held.places.size)
    switched = [not world.served.all() for world in worlds]
    models = [copy(w.model) if friction or off else w.model for w, off in zip(worlds, switched, strict=True)]
    states = plant.states(len(worlds))
    for world, model, d in zip(worlds, models, states, strict=True):
        world.begin(model, d)
    scale = np.array([world.scale for world in worlds])[:, None]
    inner = np.minimum(point["kv"], point["viscous"]) + point["back_emf"] + point["kd"] * point["gain"]
    kp, ki = point["kp"] * point["gain"] * scale, point["ki"] * scale * ~plant.pid
    loose, gear = ~plant.driven, plant.gear
    total = np.stack([world.integral() for world in worlds]) if "ki" in laws else np.zeros((len(worlds), plant.n))
    longest = max(world.steps for world in worlds)

    def whole(rows: Sequence[Array], steps: int) -> Array:
        return np.stack([np.concatenate([x, np.repeat(x[-1:], steps - len(x), axis=0)]) for x in rows], axis=1)

    given = whole([world.given for world in worlds], longest)
    served = whole([world.served for world in worlds], longest)
    switches = np.any(served[1:] != served[:-1], axis=(1, 2))
    changes = np.any(np.abs(np.diff(given, axis=0)) > SAME_RAD, axis=(1, 2))
    applied = np.stack([world.applied for world in worlds])
    pushes, dead = bool({"ki", "feed"} & {*laws}) or bool(loose.any()), "dead" in laws
    tracks = np.empty((longest + 1, len(worlds), plant.n))

    dampings = [linear_part(model.dof_damping, model.nv) for model in models]
    springs = [linear_part(model.jnt_stiffness, model.njnt) for model in models]
    kept = [(m.actuator_gainprm[drives].copy(), m.actuator_biasprm[drives].copy()) for m in models]
    outer = [damping[dofs] - np.where(plant.driven, 0.0, own) for damping, own in zip(dampings, inner, strict=True)]
    at, places_at, controls_at = _slice_of(dofs), _slice_of(places), _slice_of(plant.controls)
    now = {name: _Gathered([getattr(d, name) for d in states]) for name in _READ}
    losses = [model.dof_frictionloss for model in models]
    pushed_at, controlled = [d.qfrc_applied for d in states], [d.ctrl for d in states]
    dry = point["coulomb"]
    carried = np.zeros((len(worlds), plant.n))

    for k in range(longest):
        q, on, c = now["qpos"].read(places_at), served[k], given[k]
        tracks[k] = q
        for w in np.flatnonzero(switched).tolist() if k == 0 or switches[k - 1] else ():
            model, drive = models[w], on[w][plant.driven][:, None]
            model.actuator_gainprm[drives], model.actuator_biasprm[drives] = kept[w][0] * drive, kept[w][1] * drive
            dampings[w][dofs] = outer[w] + np.where(loose & on[w], inner[w], 0.0)
            springs[w][plant.joints] = point["spring"][w] + np.where(loose & on[w], kp[w], 0.0)
        if dead:
            c = c - np.minimum(np.maximum(c - q, -point["dead"]), point["dead"])
        if dead or k == 0 or changes[k - 1]:
            for x, control in zip(controlled, (c * gear)[:, plant.driven], strict=True):
                x[controls_at] = control
        if pushes:
            torque = np.zeros_like(q) + applied
            if "ki" in laws:
                total += dt * on * (c - q)
                torque += ki * total * on
            if loose.any():
                pushed = kp * c
                if "limit" in laws:
                    wish = kp * (c - q) - inner * now["qvel"].read(at)
                    pushed = pushed + np.clip(wish, -point["limit"], point["limit"]) - wish
                torque += loose * on * pushed
            if "feed" in laws:
                torque += (point["feed"] * on - 1.0) * now["qfrc_gravcomp"].read(at)
            for x, push in zip(pushed_at, torque, strict=True):
                x[at] = push
        if friction:
            level = dry
            if "stribeck" in laws:
                v = now["qvel"].read(at)
                level = level + point["stribeck"] * np.exp(-((v / point["stribeck_velocity"]) ** 2))
            if "load" in laws:
                level = level + point["load"] * np.abs(carried)
            for x, each in zip(losses, level, strict=True):
                x[at] = each
        for model, d in zip(models, states, strict=True):
            mujoco.mj_step(model, d)
            if held:
                plant.held.put_back(d)
        if "load" in laws:  # applied, actuator, passive and constraint force less that of the rotor
            carried = now["qfrc_smooth"].read(at) + now["qfrc_bias"].read(at) + now["qfrc_constraint"].read(at)
            carried -= point["armature"] * now["qacc"].read(at)
    tracks[longest] = now["qpos"].read(places_at)
    for w, world in enumerate(worlds):
        world.track = tracks[: world.steps + 1, w]


class _Gathered:
    """One field of many states, gathered without a new array each time."""

    def __init__(self, views: Sequence[Array]) -> None:
        self.views = views
        self.flat = np.empty(sum(map(len, views)))
        self.rows = self.flat.reshape(len(views), -1)

    def read(self, at: Any) -> Array:
        np.concatenate(self.views, out=self.flat)
        return self.rows[:, at]


def _slice_of(index: NDArray[np.intp]) -> Any:
    """An index as a slice, where it is one."""
    whole = len(index) > 0 and np.array_equal(index, np.arange(index[0], index[0] + len(index)))
    return slice(int(index[0]), int(index[0]) + len(index)) if whole else index


_READ = ("qpos", "qvel", "qfrc_smooth", "qfrc_bias", "qfrc_constraint", "qacc", "qfrc_gravcomp")


def laws_of(point: Point, plant: MovedModel) -> set[str]:
    """Names of the parameters of a point that act by a law at each step."""
    found = {name for name in ("dead", "stribeck", "load") if np.any(point[name] != 0.0)}
    if np.any(point["feed"] != plant.compensated):
        found.add("feed")
    if np.any((point["ki"] > 0.0) & ~plant.pid):
        found.add("ki")
    if np.any(np.isfinite(point["limit"]) & ~plant.driven):
        found.add("limit")
    return found
