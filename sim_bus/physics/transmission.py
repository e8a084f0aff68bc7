"""Transmissions that are no rigid one-to-one gears: motors behind springs with play, motors that other joints turn too.

Motor i turns by `φ_i = θ_i + Σ_j c_ij·θ_j` where its gear is rigid, c the coupling. Behind a spring it is a mass of
its own: the gear passes on `s = K·stretch + d·(rate of twist)`, where the twist is `φ_i − θ_i − Σ_j c_ij·θ_j` and the
stretch what of it goes beyond half the play to either side; within the play, and where the sum would pull, it passes on
nothing. The drives know the coupling and work in joint angles: their encoder shows `φ_i − Σ_j c_ij·θ_j`, and a torque
on joint i alone is asked of all motors that it takes. So coupling shows in what is lost: a motor's friction, ripple and
rotor inertia follow its own angle, and load joint j by c_ij.
"""

from typing import Any

import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections

ROTOR_SHARE = 0.1
"""A motor behind a spring has at least this share of its joint's inertia, where nothing says more."""
DAMPING_RATIO = 0.04
"""Of the spring with the rotor on it."""
PHASE_A_STEP = 0.25
"""Most that the rotor's oscillation on the spring may turn in one step of the physics [rad]."""
FINEST_STEP = 5e-5
"""Finest step that is taken for a stiff spring [s]."""
HARD_GEAR_STEP = 2.5e-4
"""Step for which a gear with play, but without an elasticity, is as stiff as can be [s]; late motors take it too."""


class Transmissions:
    """Of one built model; arrays (n,) over joints, (s,) over those with springs."""

    def __init__(self, model: Any, names: tuple[str, ...], state: Imperfections) -> None:
        """Of a model that was built for `state`; configure() comes next."""
        self._n, nv = len(names), model.nv
        self._links = np.array([model.joint(name).dofadr[0] for name in names])
        self.soft = np.flatnonzero(state.soft)
        self.rotors = np.array([model.joint(rotor_name(names[j])).dofadr[0] for j in self.soft], int)
        self._shared = np.flatnonzero(state.coupling.any(axis=1) & ~state.soft)
        self._tendons = np.array([model.tendon(tendon_name(names[j])).id for j in self._shared], int)
        self._coupling = state.coupling
        self._rigid = ~state.soft & ~state.coupling.any(axis=1)
        unit = np.eye(nv)
        by_links = state.coupling @ unit[self._links]
        self._turn = unit[self._links] + by_links
        self._reading = unit[self._links].copy()
        self._twist = unit[self.rotors] - self._turn[self.soft]
        self._turn[self.soft] = unit[self.rotors]
        self._reading[self.soft] = unit[self.rotors] - by_links[self.soft]
        self._owner = {(True, int(d)): j for j, d in enumerate(self._links)}
        self._owner |= {(True, int(d)): int(j) for j, d in zip(self.soft, self.rotors, strict=True)}
        self._owner |= {(False, int(t)): int(j) for j, t in zip(self._shared, self._tendons, strict=True)}

    def configure(self, state: Imperfections, rotors: Array) -> None:
        """Take over stiffness and play; `rotors` (n,) as rotor_inertia() says."""
        rotor, given = rotors[self.soft], state.elasticity[self.soft]
        self.stiffness = np.where(np.isfinite(given), given, rotor * (PHASE_A_STEP / HARD_GEAR_STEP) ** 2)
        self._half_play = state.backlash[self.soft] / 2
        self._damping = 2 * DAMPING_RATIO * np.sqrt(self.stiffness * rotor)
        fastest = np.sqrt(self.stiffness / rotor).max(initial=0.0)
        self.step_time = PHASE_A_STEP / fastest if fastest else np.inf
        """Longest step that resolves the springs [s]."""

    # ---- where motors have what

    def seat(self, on_dofs: Array, on_tendons: Array, values: Array) -> None:
        """Give each motor its share of friction, damping or inertia, there where the motor turns."""
        on_dofs[self._links] = np.where(self._rigid, values, 0.0)
        on_dofs[self.rotors] = values[self.soft]
        on_tendons[self._tendons] = values[self._shared]

    def friction(self, data: Any, dof_kind: int) -> Array:
        """Dry friction's torque on each motor now; `dof_kind` is the constraints' type at degrees of freedom."""
        torque, rows = np.zeros(self._n), slice(data.ne, data.ne + data.nf)
        kinds, places = data.efc_type[rows], data.efc_id[rows]
        for kind, place, force in zip(kinds, places, data.efc_force[rows], strict=True):
            torque[self._owner[bool(kind == dof_kind), int(place)]] += force
        return torque

    # ---- motion of the motors

    def settle(self, position: Array, torque: Array) -> None:
        """Put the rotors where they carry `torque` (n,) at rest; `position` (nv,) is changed."""
        load = torque[self.soft]
        stretch = load / self.stiffness + self._half_play * np.sign(load)
        position[self.rotors] = 0.0
        position[self.rotors] = stretch - self._twist @ position

    def settle_speed(self, velocity: Array) -> None:
        """Let the rotors turn with their links; `velocity` (nv,) is changed."""
        velocity[self.rotors] = 0.0
        velocity[self.rotors] = -self._twist @ velocity

    def turned(self, dofs: Array) -> Array:
        """Angles, speeds or accelerations of the motors, from those of all degrees of freedom."""
        turned: Array = self._turn @ dofs
        return turned

    def shown(self, dofs: Array) -> Array:
        """What the drives' encoders see of it, in joint angles."""
        shown: Array = self._reading @ dofs
        return shown

    # ---- torques

    def spring(self, data: Any) -> Array:
        """Torque that each spring passes on to its link now (s,)."""
        twist = self._twist @ data.qpos
        stretch = twist - np.minimum(np.maximum(twist, -self._half_play), self._half_play)
        torque = self.stiffness * stretch + self._damping * (self._twist @ data.qvel)
        return np.where((self._half_play > 0) & (torque * stretch <= 0), 0.0, torque)

    def forces(self, data: Any, lost: Array) -> Array:
        """Generalised forces (nv,) of the springs, and of a torque `lost` at each motor."""
        forces: Array = -lost @ self._turn - self.spring(data) @ self._twist
        return forces

    def on_links(self, data: Any, made: Array, passed: Array) -> Array:
        """Torque on each link: what rigid gears have `passed` of what motors `made`, what springs pass on, coupling."""
        own = passed.copy()
        own[self.soft] = self.spring(data)
        return own + self._coupling.T @ (own - made)


def rotor_inertia(names: tuple[str, ...], state: Imperfections, inertia: Array) -> Array:
    """Inertia of the motors behind springs, 0 for the others, where the joints have `inertia` (n,) [kg·m²].

    Raises ValueError where a spring is too stiff to be simulated.
    """
    rotors = np.where(state.soft, np.maximum(state.rotor_inertia, ROTOR_SHARE * inertia), 0.0)
    stiffest = rotors * (PHASE_A_STEP / FINEST_STEP) ** 2
    for name, stiffness, most in zip(names, state.elasticity, stiffest, strict=True):
        if np.isfinite(stiffness) and stiffness > most:
            raise ValueError(
                f"transmission.elasticity: {name}: {stiffness:g} N·m/rad is as good as rigid, at most "
                f"{most:.3g} can be simulated: leave the effect out"
            )
    return np.asarray(rotors)


def rotor_name(joint: str) -> str:
    """Name in the model of the motor behind a spring."""
    return f"rotor {joint}"


def tendon_name(joint: str) -> str:
    """Name in the model of the angle of a motor that turns with several joints."""
    return f"motor angle {joint}"
