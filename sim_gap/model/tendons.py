"""Motors coupled to two joints, in MuJoCo fixed tendons with inertia, damping and friction loss."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CoupledMotor:
    """A motor that turns by q_joint + lever·q_other and so loads both joints."""

    joint: str
    other: str
    lever: float
    inertia: float
    """[kg·m²]."""
    coulomb: float
    """[N·m]."""
    viscous: float
    """[N·m·s/rad]."""


@dataclass(frozen=True)
class Tendons:
    """The m fixed tendons of a model, restricted to the n joints of an arm."""

    turns: Array
    """Turn of each tendon per turn of each joint, (m, n)."""
    armature: Array
    damping: Array
    frictionloss: Array
    """(m,) each: kg·m², N·m·s/rad, N·m."""

    def torque(self, v: Array, a: Array, creep: float) -> Array:
        """Motor torque that they take [N·m], (…, n); the sign of friction is linear within `creep` [rad/s]."""
        speed, push = v @ self.turns.T, a @ self.turns.T
        along = np.clip(speed / creep, -1.0, 1.0)
        return np.asarray((self.armature * push + self.damping * speed + self.frictionloss * along) @ self.turns)


def add_to(spec: Any, motors: Sequence[CoupledMotor]) -> None:
    """Add the motors to a `mujoco.MjSpec`."""
    for number, motor in enumerate(motors, start=1):
        tendon = spec.add_tendon(name=f"motor_{number}_of_{motor.joint}_and_{motor.other}")
        tendon.wrap_joint(motor.joint, 1.0)
        tendon.wrap_joint(motor.other, motor.lever)
        tendon.armature, tendon.frictionloss = motor.inertia, motor.coulomb
        tendon.damping[0] = motor.viscous


def tendons_of(model: Any, joints: Sequence[int]) -> Tendons:
    """The fixed tendons of a compiled model over its joints `joints`; spatial tendons are left out."""
    import mujoco

    rows, which = [], []
    for tendon in range(model.ntendon):
        wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        if any(model.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
            continue
        turns = np.zeros(len(joints))
        for w in wraps:
            if model.wrap_objid[w] in joints:
                turns[list(joints).index(model.wrap_objid[w])] += model.wrap_prm[w]
        rows.append(turns)
        which.append(tendon)
    damping = np.reshape(model.tendon_damping, (model.ntendon, -1))[which, 0] if which else np.zeros(0)
    return Tendons(
        turns=np.reshape(rows, (len(which), len(joints))),
        armature=model.tendon_armature[which].copy(),
        damping=damping.copy(),
        frictionloss=model.tendon_frictionloss[which].copy(),
    )
