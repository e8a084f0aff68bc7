"""The simulation model (MJCF, URDF or arm file), compiled by MuJoCo, its joints matched to those of a recording."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armlink.errors import BadInput
from sim_gap.model.rigid_body import RigidArm, rigid_arm
from sim_gap.model.spec import compiled


@dataclass(frozen=True)
class SimModel:
    """A compiled MuJoCo model, those of its joints that the recordings have, and its rigid arm."""

    mujoco_model: Any
    joints: tuple[int, ...]
    """MuJoCo joint ids, base to tip."""
    arm: RigidArm
    path: Path | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)


def load_model(source: Any, names: tuple[str, ...] = (), count: int | None = None) -> SimModel:
    """Compile a model from a path (.xml, .urdf, .yaml arm file), or take a compiled `mujoco.MjModel`.

    `names` are the recording's joint names if it has any; `count` is its number of joints. Joints are matched by name
    if the model has all of them, else in order. Raises BadInput if the model cannot be read or does not fit.
    """
    import mujoco

    path = Path(source) if isinstance(source, str | Path) else None
    model = source if path is None else compiled(path)
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    known = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j): j for j in hinges}
    label = str(path or "the model")
    if names and all(name in known for name in names):
        joints = [known[name] for name in names]
    else:
        if count is not None and count != len(hinges):
            raise BadInput(
                f"{label}: has {len(hinges)} hinge joints ({', '.join(map(str, known))}), the recording {count}: "
                "give the model of the recorded arm, or a recording with the model's joint names"
            )
        joints = hinges
    if not joints:
        raise BadInput(f"{label}: no hinge joint in the model: expected the arm as a chain of hinges")
    arm = rigid_arm(model, joints)
    if any(up >= j for j, up in enumerate(arm.parent)):
        raise BadInput(f"{label}: joints {', '.join(arm.names)} do not run from base to tip: reorder them")
    _check(model, joints, arm, label)
    return SimModel(model, tuple(joints), arm, path)


def _check(model: Any, joints: list[int], arm: RigidArm, label: str) -> None:
    """Compare with mj_inverse at random states. Raises BadInput for a model with parts that the chain leaves out."""
    import mujoco

    data, random = mujoco.MjData(model), np.random.default_rng(0)
    adr, dof = model.jnt_qposadr[list(joints)], model.jnt_dofadr[list(joints)]
    flags, model.opt.disableflags = model.opt.disableflags, model.opt.disableflags | _WITHOUT_CONTACT
    losses = [(loss, loss.copy()) for loss in (model.dof_frictionloss, model.tendon_frictionloss)]
    for loss, _ in losses:
        loss[:] = 0.0
    arm = replace(arm, tendons=replace(arm.tendons, frictionloss=0.0 * arm.tendons.frictionloss))
    try:
        q, v, a = (random.uniform(-1, 1, (3, arm.n)) for _ in range(3))
        for row in range(3):
            data.qpos[:], data.qvel[:], data.qacc[:] = model.qpos0, 0.0, 0.0
            data.qpos[adr], data.qvel[dof], data.qacc[dof] = q[row], v[row], a[row]
            mujoco.mj_inverse(model, data)
            ours = arm.torque(q[row : row + 1], v[row : row + 1], a[row : row + 1])[0]
            ours += arm.nominal_joint_torque(q[row], v[row], a[row], np.zeros(arm.n))
            worst = int(np.argmax(np.abs(ours - data.qfrc_inverse[dof])))
            if abs(ours[worst] - data.qfrc_inverse[dof][worst]) > 1e-6 * (1.0 + np.abs(ours).max()):
                raise BadInput(
                    f"{label}: joint {arm.names[worst]}: the model's torque is {data.qfrc_inverse[dof][worst]:.6g} "
                    f"N·m, its rigid chain gives {ours[worst]:.6g}: expected a plain hinge chain (no springs between "
                    "joints, gravity compensation, fluid forces or joint equalities)"
                )
    finally:
        model.opt.disableflags = flags
        for loss, was in losses:
            loss[:] = was


_WITHOUT_CONTACT = 1 | (1 << 4) | (1 << 3)  # mjDSBL_CONSTRAINT, CONTACT, LIMIT
