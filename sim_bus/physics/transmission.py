"""Elastic and coupled transmissions: motors behind springs with play, motors that turn with several joints.

With a rigid gear, motor i turns by `φ_i = θ_i + Σ_j c_ij·θ_j`, with the coupling c. Behind a spring it is a separate
mass: the gear transmits `s = K·stretch + d·(rate of twist)`, with the twist `φ_i − θ_i − Σ_j c_ij·θ_j` and the stretch
as its part beyond half the play to either side. It transmits nothing within the play, or if the sum would pull. The
drives know the coupling and work in joint angles: their encoder shows `φ_i − Σ_j c_ij·θ_j`, and a torque on joint i
alone is distributed to all motors involved. Coupling therefore appears in the losses only: a motor's friction, ripple
and rotor inertia follow its own angle, and load joint j by c_ij.
"""

from typing import Any

import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections

ROTOR_SHARE = 0.1
"""Default inertia of a motor behind a spring, as a share of its joint's inertia."""
DAMPING_RATIO = 0.04
"""Damping ratio of rotor and spring."""
PHASE_A_STEP = 0.25
"""Maximum phase of the rotor's oscillation on the spring per physics step [rad]."""
FINEST_STEP = 5e-5
"""Minimum step for a stiff spring [s]."""
HARD_GEAR_STEP = 2.5e-4
"""Step for gears with play but no elasticity, made as stiff as it allows, and for delayed motors [s]."""


class Transmissions:
    """Transmissions of a built model; arrays (n,) over joints, (s,) over joints with springs."""

    def __init__(self, model: Any, names: tuple[str, ...], state: Imperfections) -> None:
        """Transmissions of a model built for `state`; to be followed by configure()."""
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
        """Set stiffness and play; `rotors` (n,) from rotor_inertia()."""
        rotor, given = rotors[self.soft], state.elasticity[self.soft]
        self.stiffness = np.where(np.isfinite(given), given, rotor * (PHASE_A_STEP / HARD_GEAR_STEP) ** 2)
        self._half_play = state.backlash[self.soft] / 2
        self._damping = 2 * DAMPING_RATIO * np.sqrt(self.stiffness * rotor)
        fastest = np.sqrt(self.stiffness / rotor).max(initial=0.0)
        self.step_time = PHASE_A_STEP / fastest if fastest else np.inf
        """Longest step that resolves the springs [s]."""

    # ---- parameters of the motors

    def seat(self, on_dofs: Array, on_tendons: Array, values: Array) -> None:
        """Set each motor's friction, damping or inertia at the degree of freedom where it turns."""
        on_dofs[self._links] = np.where(self._rigid, values, 0.0)
        on_dofs[self.rotors] = values[self.soft]
        on_tendons[self._tendons] = values[self._shared]

    def friction(self, data: Any, dof_kind: int) -> Array:
        """Present dry friction torque on each motor; `dof_kind` is the constraint type at degrees of freedom."""
        torque, rows = np.zeros(self._n), slice(data.ne, data.ne + data.nf)
        kinds, places = data.efc_type[rows], data.efc_id[rows]
        for kind, place, force in zip(kinds, places, data.efc_force[rows], strict=True):
            torque[self._owner[bool(kind == dof_kind), int(place)]] += force
        return torque

    # ---- motion of the motors

    def settle(self, position: Array, torque: Array) -> None:
        """Place the rotors so that they carry `torque` (n,) at rest; changes `position` (nv,)."""
        load = torque[self.soft]
        stretch = load / self.stiffness + self._half_play * np.sign(load)
        position[self.rotors] = 0.0
        position[self.rotors] = stretch - self._twist @ position

    def settle_speed(self, velocity: Array) -> None:
        """Make the rotors turn with their links; changes `velocity` (nv,)."""
        velocity[self.rotors] = 0.0
        velocity[self.rotors] = -self._twist @ velocity

    def turned(self, dofs: Array) -> Array:
        """Angles, speeds or accelerations of the motors, from those of all degrees of freedom."""
        turned: Array = self._turn @ dofs
        return turned

    def shown(self, dofs: Array) -> Array:
        """Values at the drives' encoders, in joint coordinates."""
        shown: Array = self._reading @ dofs
        return shown

    # ---- torques

    def spring(self, data: Any) -> Array:
        """Present torque of each spring on its link (s,)."""
        twist = self._twist @ data.qpos
        stretch = twist - np.minimum(np.maximum(twist, -self._half_play), self._half_play)
        torque = self.stiffness * stretch + self._damping * (self._twist @ data.qvel)
        return np.where((self._half_play > 0) & (torque * stretch <= 0), 0.0, torque)

    def forces(self, data: Any, lost: Array) -> Array:
        """Generalised forces (nv,) of the springs, and of a torque `lost` at each motor."""
        forces: Array = -lost @ self._turn - self.spring(data) @ self._twist
        return forces

    def on_links(self, data: Any, made: Array, passed: Array) -> Array:
        """Torque on each link: `passed` by rigid gears of the motors' `made` torque, plus springs and coupling."""
        own = passed.copy()
        own[self.soft] = self.spring(data)
        return own + self._coupling.T @ (own - made)


def rotor_inertia(names: tuple[str, ...], state: Imperfections, inertia: Array) -> Array:
    """Inertia of the motors behind springs, 0 for the others, with joint inertias `inertia` (n,) [kg·m²].

    Raises ValueError where a spring is too stiff to be simulated.
    """
    rotors = np.where(state.soft, np.maximum(state.rotor_inertia, ROTOR_SHARE * inertia), 0.0)
    stiffest = rotors * (PHASE_A_STEP / FINEST_STEP) ** 2
    for name, stiffness, most in zip(names, state.elasticity, stiffest, strict=True):
        if np.isfinite(stiffness) and stiffness > most:
            raise ValueError(
                f"transmission.elasticity: {name}: {stiffness:g} N·m/rad is nearly rigid, and at most "
                f"{most:.3g} N·m/rad can be simulated: leave the effect out"
            )
    return np.asarray(rotors)


def rotor_name(joint: str) -> str:
    """Name of the motor behind a spring in the model."""
    return f"rotor {joint}"


def tendon_name(joint: str) -> str:
    """Name of the angle of a coupled motor in the model."""
    return f"motor angle {joint}"
