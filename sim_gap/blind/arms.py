"""Arms drawn at random: 3 to 7 hinges, plausible links, any mounting; written as MJCF.

The nominal arm is that of `sim.xml`; `perturb` is the arm that the plant simulates, with small errors everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy import constants

from gcomp.arm.inertials import steiner
from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class BenchArm:
    """A chain of n links; link k hangs on joint k, whose axis runs through the link frame's origin."""

    offset: Array
    """Link frame's origin in the parent's frame [m], (n, 3)."""
    rotation: Array
    """Link frame at joint angle zero in the parent's frame, (n, 3, 3)."""
    axis: Array
    """Joint axis in the link frame, (n, 3)."""
    mass: Array
    """[kg], (n,)."""
    com: Array
    """Centre of mass in the link frame [m], (n, 3)."""
    inertia: Array
    """About the centre of mass, in the link frame [kg·m²], (n, 3, 3)."""
    armature: Array
    """Rotor inertia at the joint [kg·m²], (n,)."""
    damping: Array
    """[N·m·s/rad], (n,)."""
    frictionloss: Array
    """Coulomb friction [N·m], (n,)."""
    lower: Array
    upper: Array
    """Joint limits [rad], (n,)."""
    gravity: Array
    """In the base frame [m/s²], (3,)."""

    @property
    def n(self) -> int:
        return len(self.mass)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"joint_{k + 1}" for k in range(self.n))

    def with_added(self, link: int, mass: float, moment: Array, inertia: Array) -> "BenchArm":
        """The arm with mass [kg], first moment [kg·m] and inertia about the link's origin [kg·m²] added to one link."""
        total = self.mass[link] + mass
        com = (self.mass[link] * self.com[link] + moment) / total
        about_origin = self.inertia[link] + self.mass[link] * steiner(self.com[link]) + inertia
        return self.with_entries(link, mass=total, com=com, inertia=about_origin - total * steiner(com))

    def with_entries(self, joint: int, **entries: float | Array) -> "BenchArm":
        """The arm with other values of one link or joint in some of its arrays."""
        arrays = {name: getattr(self, name).copy() for name in entries}
        for name, value in entries.items():
            arrays[name][joint] = value
        return replace(self, **arrays)

    def with_moved(self, link: int, moment: Array) -> "BenchArm":
        """The arm with the centre of mass of one link moved so that its first moment grows by `moment` [kg·m]."""
        return self.with_entries(link, com=self.com[link] + moment / self.mass[link])


def draw_arm(random: np.random.Generator, joints: int | None = None) -> BenchArm:
    n = int(random.integers(3, 8)) if joints is None else joints
    length = np.linspace(random.uniform(0.25, 0.45), random.uniform(0.08, 0.2), n) * random.uniform(0.7, 1.3, n)
    mass = np.geomspace(random.uniform(5.0, 14.0), random.uniform(1.0, 2.5), n) * random.uniform(0.8, 1.25, n)
    bone = np.array([_bone(random) for _ in range(n)]) * length[:, None]
    frame = np.array([_signed_axes(random) for _ in range(n)])  # Denavit-Hartenberg frame to link frame
    com = bone * random.uniform(0.3, 0.6, (n, 1)) + random.normal(0.0, 0.1, (n, 3)) * length[:, None]
    com[-1] = bone[-1] * 0.4 + random.choice([-1.0, 1.0], 3) * random.uniform(0.03, 0.08, 3)  # a tool
    twist = [np.eye(3), *(_about_x(_twist(random)) for _ in range(n - 1))]
    parent = [np.eye(3), *frame[:-1]]
    places = [np.array([0.0, 0.0, random.uniform(0.1, 0.4)]), *bone[:-1]]
    half = random.uniform(1.2, 2.6, n)
    centre = random.uniform(-0.3, 0.3, n)
    lossy = random.random() < 0.4  # some models come with measured friction
    return BenchArm(
        offset=np.array([p.T @ place for p, place in zip(parent, places, strict=True)]),
        rotation=np.array([p.T @ turn @ own for p, turn, own in zip(parent, twist, frame, strict=True)]),
        axis=frame[:, 2, :].copy(),  # ownᵀ z
        mass=mass,
        com=np.einsum("nji,nj->ni", frame, com),
        inertia=np.array([f.T @ _rod(m, b, random) @ f for f, m, b in zip(frame, mass, bone, strict=True)]),
        armature=np.geomspace(random.uniform(0.3, 1.0), random.uniform(0.03, 0.1), n) * random.uniform(0.7, 1.4, n),
        damping=lossy * np.geomspace(1.5, 0.1, n) * random.uniform(0.5, 1.5, n),
        frictionloss=lossy * np.geomspace(2.0, 0.2, n) * random.uniform(0.5, 1.5, n),
        lower=np.round(centre - half, 3),
        upper=np.round(centre + half, 3),
        gravity=_mounting(random) @ np.array([0.0, 0.0, -constants.g]),
    )


def perturb(arm: BenchArm, random: np.random.Generator) -> BenchArm:
    """The arm with manufacturing errors: mass moments and rotors about 1 %, inertias 2 %, masses 0.3 %."""
    n, small = arm.n, np.clip(random.normal(0.0, 0.5, (3, arm.n)), -1.0, 1.0)
    return replace(
        arm,
        mass=arm.mass * (1.0 + 0.003 * small[0]),
        com=arm.com * (1.0 + 0.007 * np.clip(random.normal(0.0, 0.5, (n, 3)), -1.0, 1.0)),
        inertia=arm.inertia * (1.0 + 0.02 * small[1])[:, None, None],
        armature=arm.armature * (1.0 + 0.01 * small[2]),
    )


def mjcf(arm: BenchArm, more: Sequence[str] = ()) -> str:
    lines = [
        '<mujoco model="arm">',
        '<compiler angle="radian"/>',
        f'<option gravity="{_text(arm.gravity)}"/>',
        "<worldbody>",
    ]
    for k, name in enumerate(arm.names):
        inertia = arm.inertia[k][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        span, axes = _text([arm.lower[k], arm.upper[k]]), _text(arm.rotation[k][:, :2].T.ravel())
        lines += [
            f'<body name="link_{k + 1}" pos="{_text(arm.offset[k])}" xyaxes="{axes}">',
            f'<joint name="{name}" type="hinge" axis="{_text(arm.axis[k])}" range="{span}"'
            f' limited="true" armature="{arm.armature[k]:.12g}" damping="{arm.damping[k]:.12g}"'
            f' frictionloss="{arm.frictionloss[k]:.12g}"/>',
            f'<inertial pos="{_text(arm.com[k])}" mass="{arm.mass[k]:.12g}" fullinertia="{_text(inertia)}"/>',
        ]
    return "\n".join([*lines, *["</body>"] * arm.n, "</worldbody>", *more, "</mujoco>", ""])


def _text(values: Array | list[float]) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(values).tolist())


def _bone(random: np.random.Generator) -> Array:
    """Direction of a link: along its joint's axis or across it, slightly perturbed."""
    direction = np.array([0.0, 0.0, 1.0]) if random.random() < 0.4 else np.array([random.choice([-1.0, 1.0]), 0.0, 0.0])
    return direction + random.normal(0.0, 0.15, 3)


def _twist(random: np.random.Generator) -> float:
    kind = random.random()
    if kind < 0.65:
        return float(random.choice([-1.0, 1.0])) * np.pi / 2
    return 0.0 if kind < 0.85 else float(random.uniform(-1.3, 1.3))


def _signed_axes(random: np.random.Generator) -> Array:
    """A right-handed frame whose axes are a permutation of ±x, ±y, ±z."""
    frame = np.eye(3)[random.permutation(3)] * random.choice([-1.0, 1.0], 3)[:, None]
    frame[:, 0] *= np.linalg.det(frame)
    return np.asarray(frame)


def _mounting(random: np.random.Generator) -> Array:
    """Rotation of the base: upright, hanging, on a wall or at another angle."""
    kind = random.random()
    angle = 0.0 if kind < 0.55 else np.pi if kind < 0.65 else np.pi / 2 if kind < 0.8 else random.uniform(0.2, 1.2)
    return _about_x(float(angle))


def _about_x(angle: float) -> Array:
    cosine, sine = np.cos(angle).round(15), np.sin(angle).round(15)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def _rod(mass: float, bone: Array, random: np.random.Generator) -> Array:
    """Inertia of a thick rod along the bone [kg·m²], slightly rotated."""
    length, radius = float(np.linalg.norm(bone)), random.uniform(0.03, 0.07)
    along = bone / length
    across, axial = mass * (length**2 / 12 + radius**2 / 4), mass * radius**2 / 2
    rod = across * (np.eye(3) - np.outer(along, along)) + axial * np.outer(along, along)
    turn = _about_x(random.normal(0.0, 0.15))
    return np.asarray(turn @ rod @ turn.T)


def compile_arm(arm: BenchArm) -> Any:
    """The arm's links and rotors as a MuJoCo model without friction, damping or limits."""
    model, off = mujoco.MjModel.from_xml_string(mjcf(arm)), mujoco.mjtDisableBit
    for part in ("CONSTRAINT", "CONTACT", "SENSOR", "ACTUATION", "DAMPER", "SPRING"):
        model.opt.disableflags |= int(getattr(off, f"mjDSBL_{part}"))
    return model


def inverse(model: Any, q: Array, v: Array, a: Array) -> Array:
    """Torques M(q) a + C(q, v) v + ∂V/∂q [N·m] along a trajectory, (K, n) each; rotors as in the model."""
    data, out = mujoco.MjData(model), np.empty(q.shape)
    qpos, qvel, qacc, torque = data.qpos, data.qvel, data.qacc, data.qfrc_inverse
    for k in range(len(q)):
        qpos[:], qvel[:], qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, data)
        out[k] = torque
    return out


def mass_matrices(model: Any, q: Array) -> Array:
    """Joint-space inertia at the poses `q` (K, n) → (K, n, n) [kg·m²]."""
    still = np.zeros_like(q)
    weight = inverse(model, q, still, still)
    columns = [inverse(model, q, still, np.broadcast_to(push, q.shape)) - weight for push in np.eye(q.shape[1])]
    return np.stack(columns, axis=2)


def controlled_inertia(model: Any, q: Array) -> Array:
    """Inertia of each joint for a controller's gains [kg·m²], (n,): the largest over the poses `q` (K, n), but at most
    twice the least with the other joints free (1/(M⁻¹)_jj), for stability.
    """
    mass = mass_matrices(model, q)
    free = 1.0 / np.diagonal(np.linalg.inv(mass), axis1=1, axis2=2)
    return np.asarray(np.minimum(np.diagonal(mass, axis1=1, axis2=2).max(0), 2.0 * free.min(0)))
