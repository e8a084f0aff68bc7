"""The simulation model (MJCF, URDF or arm file), compiled by MuJoCo, its joints matched to those of a recording."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from armlink.arm_file import bundled_arms, load_arm
from armlink.errors import BadInput
from armlink.model_file import add_actuator, compile_spec, is_urdf, read_model
from gcomp.arm.inertials import fixed_body_parameters
from gcomp.arm.model_file import HAND, coupled_joints, linear_part, links_of_bodies, upwards
from gcomp.arm.rigid_body import RigidArm, Tendons
from gcomp.arrays import Array
from sim_gap.model.solver_friction import creep_speeds


@dataclass(frozen=True, eq=False)
class KnownGains:
    """Gains by joint, (n,) each; one value for all is (1,)."""

    kp: Array
    """[N·m/rad]"""
    kd: Array
    """[N·m·s/rad]"""

    def of_joints(self, count: int) -> "KnownGains":
        """The same for so many joints. Raises BadInput where there are values for another number."""
        for name, values in (("kp", self.kp), ("kd", self.kd)):
            if len(values) not in (1, count):
                raise BadInput(
                    f"--gains {name}: {len(values)} values for {count} joints: give one value, or one for each joint"
                )
        return replace(self, **{name: np.resize(x, count) for name, x in (("kp", self.kp), ("kd", self.kd))})


def parse_known_gains(text: str) -> KnownGains | None:
    """Read `kp=20,kd=1.5` or `kp=20;20;30,kd=1;1;1.5`; None for an empty text. Raises BadInput."""
    if not text:
        return None
    found: dict[str, Array] = {}
    for part in text.split(","):
        name, _, values = part.strip().partition("=")
        try:
            numbers = np.array([float(value) for value in values.split(";")])
        except ValueError:
            numbers = np.array([np.nan])
        positive = bool(np.all(np.isfinite(numbers) & (numbers >= 0.0))) and (name != "kp" or bool(np.all(numbers > 0)))
        if name not in ("kp", "kd") or name in found or not positive:
            raise BadInput(f"--gains {part.strip()}: expected kp=VALUE,kd=VALUE in N·m/rad and N·m·s/rad, or kp=A;B;…")
        found[name] = numbers
    if "kp" not in found:
        raise BadInput(f"--gains {text}: kp is missing: give kp=VALUE,kd=VALUE")
    return KnownGains(found["kp"], found.get("kd", np.zeros(1)))


def put_gains(spec: Any, joints: Sequence[int], gains: KnownGains) -> None:
    """Give joints of a compiled `mujoco.MjSpec` position actuators with these gains in place of what drives them."""
    for j, joint in enumerate(joints):
        name = spec.joints[joint].name
        old = [a for a in spec.actuators if a.target == name and a.trntype == mujoco.mjtTrn.mjTRN_JOINT]
        limits = [list(a.forcerange) for a in old if a.forcerange[0] < a.forcerange[1]]
        called = old[0].name if old else f"position_{name}"
        for actuator in old:
            spec.delete(actuator)
        made = add_actuator(spec, called, name)
        made.set_to_position(kp=float(gains.kp[j]), kv=float(gains.kd[j]))
        if limits:
            made.forcelimited, made.forcerange = 1, limits[0]


def ends_of(source: Any) -> tuple[str | None, str | None]:
    """Bodies between which the arm of an arm file lies in its model (`kinematics.base`, `kinematics.tip`), or None."""
    if not isinstance(source, str | Path) or not is_arm_file(Path(source)):
        return None, None
    kinematics = load_arm(str(source)).kinematics
    return kinematics.base, kinematics.tip


def is_arm_file(path: Path) -> bool:
    """Whether this is an arm file (by path or bundled name) and no model."""
    return path.suffix in (".yaml", ".yml") or str(path) in bundled_arms()


def nominal_model(path: Path) -> Any:
    """Path of the model of an arm file (by path or bundled name), or the `mujoco.MjSpec` of its `sim` section.

    The model counts if the section gives no masses of its own, so that both give the same answer. The section's effects
    are left out. Raises BadInput if the file has no masses.
    """
    arm = load_arm(str(path))
    if arm.model_path is not None and not (isinstance(arm.sim, dict) and arm.sim.get("links")):
        return arm.model_path
    if arm.sim is not None:
        # only here: a diagnosis of other models, and so the sealed check, goes without the simulated arm
        from sim_bus.effects.state import Imperfections
        from sim_bus.physics.mjcf import build_model

        spec = build_model(arm, Imperfections(arm.joint_names)).spec
        for joint in spec.joints:
            joint.frictionloss = 0.0  # the simulated arm sets its friction at run time
        return spec
    raise BadInput(f"{path} has no masses: give kinematics.model (URDF or MJCF), the key sim, or --sim MJCF")


def joints_of(model: Any) -> dict[str, int]:
    """Joints that an arm may have, with their ids: hinges, and slides but for those of a hand (named so, coupled, or
    several on one body)."""
    named = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j + 1}": j for j in range(model.njnt)}
    slides = {name: j for name, j in named.items() if is_slide(model, j)}
    carriers = Counter(int(model.body_parentid[model.jnt_bodyid[j]]) for j in slides.values())
    coupled = coupled_joints(model)

    def of_the_arm(name: str, joint: int) -> bool:
        alone = carriers[int(model.body_parentid[model.jnt_bodyid[joint]])] == 1
        return alone and name not in coupled and not HAND.search(name)

    return {
        name: j
        for name, j in named.items()
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE or (name in slides and of_the_arm(name, j))
    }


def is_slide(model: Any, joint: int) -> bool:
    return bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)


def joints_between(model: Any, base: str | None, tip: str | None) -> dict[str, int]:
    """Joints that body `base` carries (default: the world) on the way to body `tip` (default: all). Raises BadInput."""
    if base is None and tip is None:
        return joints_of(model)
    first = 0 if base is None else _body(model, base, "base")
    last = None if tip is None else upwards(model, _body(model, tip, "tip"))
    if last is not None and first not in last:
        raise BadInput(
            f"--base {base} --tip {tip}: the base body does not carry the tip body: give the bodies of one arm"
        )
    found = {}
    for name, joint in joints_of(model).items():
        body = int(model.jnt_bodyid[joint])
        if first in upwards(model, body)[1:] and (last is None or body in last):
            found[name] = joint
    if not found:
        raise BadInput(f"--base {base or 'world'} --tip {tip or 'any'}: there is no joint between these bodies")
    return found


def longest_chain(model: Any, joints: dict[str, int], label: str) -> dict[str, int]:
    """The longest chain of some joints, without coupled joints and those of a hand at its end.

    Raises BadInput for several chains of that length, as of a model with two arms.
    """
    coupled = coupled_joints(model)
    ways: list[list[str]] = []
    for tip in joints.values():
        carriers = set(upwards(model, int(model.jnt_bodyid[tip])))
        way = [name for name, joint in joints.items() if int(model.jnt_bodyid[joint]) in carriers]
        while way and (way[-1] in coupled or HAND.search(way[-1])):
            way.pop()
        if way not in ways:
            ways.append(way)
    longest = max(map(len, ways), default=0)
    arms = [way for way in ways if len(way) == longest]
    if longest and len(arms) > 1:
        tips = ", ".join(model.body(int(model.jnt_bodyid[joints[way[-1]]])).name for way in arms)
        raise BadInput(
            f"{label}: has {len(arms)} arms of {longest} joints: choose an arm by its last body with --tip: {tips}"
        )
    return {name: joints[name] for way in arms for name in way}


def recorded_joints(
    model: Any, known: dict[str, int], names: tuple[str, ...], count: int | None, label: str
) -> list[int]:
    """Those of the known joints that a recording has: by its names, else in order, and then slides only if the hinges
    alone are not as many. Raises BadInput if their number does not fit."""
    if not known:
        raise BadInput(f"{label}: the model has no hinge or slide: expected the arm as a chain of joints")
    if names and all(name in known for name in names):
        return [known[name] for name in names]
    hinges = {name: joint for name, joint in known.items() if not is_slide(model, joint)}
    if count is None:
        return list((hinges or known).values())
    for some in (hinges, known):
        chain = some if len(some) == count else longest_chain(model, some, label)
        if len(chain) == count:
            return list(chain.values())
    slides = [name for name in known if name not in hinges]
    text = f"{len(hinges)} hinge joints ({', '.join(hinges)})"
    text += f" and {len(slides)} prismatic joints ({', '.join(slides)})" if slides else ""
    raise BadInput(
        f"{label}: has {text}, but the recording has {count}: give the model of the recorded arm, or a recording with "
        "the joint names of the model"
    )


def _body(model: Any, name: str, option: str) -> int:
    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    if body < 0:
        names = ", ".join(model.body(each).name for each in range(1, model.nbody))
        raise BadInput(f"--{option} {name}: the model has no such body; expected one of {names}")
    return body


@dataclass(frozen=True)
class SimModel:
    """A compiled MuJoCo model, those of its joints that the recordings have, and its rigid arm."""

    mujoco_model: Any
    joints: tuple[int, ...]
    """MuJoCo joint ids, base to tip."""
    arm: RigidArm
    path: Path | None = None
    gains: KnownGains | None = None
    """Gains of the position controller that the user states in place of the file's."""

    @property
    def n(self) -> int:
        return len(self.joints)


def load_model(
    source: Any,
    names: tuple[str, ...] = (),
    count: int | None = None,
    known: Mapping[str, int] | None = None,
    path: Path | None = None,
) -> SimModel:
    """Compile a model from a path (.xml, .urdf, .yaml arm file), or take a compiled `mujoco.MjModel`.

    `names` are the recording's joint names if it has any; `count` is its number of joints; `known` are the joints that
    may be the arm's, with their ids (`joints_between`), by default all. Joints are matched by name if the model has all
    of them, else in order; if there are too many, those of a hand and coupled ones are locked. `path` is the file of a
    compiled model. Raises BadInput if the model cannot be read or does not fit.
    """
    path = Path(source) if isinstance(source, str | Path) else path
    model = load_compiled(source)
    label = str(path or "the model")
    joints = recorded_joints(model, joints_of(model) if known is None else dict(known), names, count, label)
    arm = rigid_arm(model, joints)
    if any(up >= j for j, up in enumerate(arm.parent)):
        order = ",".join(name for _, name in sorted(zip(joints, arm.names, strict=True)))
        raise BadInput(
            f"{label}: the joints of the recording, {', '.join(arm.names)}, are not in the order from base to tip: "
            f"give --joints {order}"
        )
    _check(model, joints, arm, label)
    return SimModel(model, tuple(joints), arm, path)


def with_gains(sim: SimModel, gains: KnownGains) -> SimModel:
    """The model with position controllers of these gains at its joints. Raises BadInput for a model without a file."""
    sim = replace(sim, gains=gains.of_joints(sim.n))
    return replace(sim, mujoco_model=named_spec(sim).compile())


def named_spec(sim: SimModel) -> Any:
    """The nominal model's file as a `mujoco.MjSpec`, with the stated gains, its elements numbered and joints named.

    Raises BadInput if the model did not come from a file.
    """
    if sim.path is None:
        raise BadInput("this needs a model that came from a file: give MJCF, URDF or an arm file with --sim")
    spec = read_spec(sim.path)
    spec.compile()
    for name, joint in zip(sim.arm.names, sim.joints, strict=True):
        spec.joints[joint].name = spec.joints[joint].name or name
    if sim.gains is not None:
        put_gains(spec, sim.joints, sim.gains)
        spec.compile()
    return spec


def load_compiled(source: Any) -> Any:
    """The `mujoco.MjModel` of an MJCF, URDF or arm file, by path or bundled name, or the one given. Raises BadInput."""
    return compile_spec(read_spec(Path(source)), Path(source)) if isinstance(source, str | Path) else source


def read_spec(path: Path) -> Any:
    """Read an MJCF, URDF or arm file (by path or bundled name) as a `mujoco.MjSpec`. Raises BadInput."""
    if is_arm_file(path):
        nominal, kinematics = nominal_model(path), load_arm(str(path)).kinematics
        if not isinstance(nominal, Path):
            return nominal
        spec = read_model(nominal, kinematics.locked).spec
        spec.option.gravity = kinematics.gravity  # as it is mounted
        return spec
    if not path.is_file():
        raise BadInput(f"there is no model file {path}: give an MJCF, URDF or arm file")
    return read_model(path).spec


def urdf_behind(path: Path | None) -> Path | None:
    """The URDF file that a model was read from, also by an arm file; None if it is of another kind."""
    source = nominal_model(path) if path is not None and is_arm_file(path) else path
    return source if isinstance(source, Path) and is_urdf(source) else None


def rigid_arm(model: Any, joints: Sequence[int]) -> RigidArm:
    """The chain of the MuJoCo joints `joints` (hinges and slides, base to tip) of a compiled model.

    Other joints of the model are locked at qpos0; bodies on them belong to the link that carries them.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    frames = [(data.xmat[model.jnt_bodyid[j]].reshape(3, 3).copy(), data.xanchor[j].copy()) for j in joints]
    links = links_of_bodies(model, joints)
    parent = tuple(links[int(model.body_parentid[model.jnt_bodyid[j]])] for j in joints)
    inertial = np.zeros((len(joints), 10))
    for body, link in enumerate(links):
        if link >= 0:
            own = int(model.jnt_bodyid[joints[link]])
            inertial[link] += fixed_body_parameters(model, data, body, own, model.jnt_pos[joints[link]])
    ups = [frames[p] if p >= 0 else (np.eye(3), np.zeros(3)) for p in parent]
    dof, adr = [int(model.jnt_dofadr[j]) for j in joints], [int(model.jnt_qposadr[j]) for j in joints]
    return RigidArm(
        names=tuple(
            mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint_{i + 1}" for i, j in enumerate(joints)
        ),
        parent=parent,
        rotation=np.array([up[0].T @ own[0] for up, own in zip(ups, frames, strict=True)]),
        offset=np.array([up[0].T @ (own[1] - up[1]) for up, own in zip(ups, frames, strict=True)]),
        axis=np.array([model.jnt_axis[j] / np.linalg.norm(model.jnt_axis[j]) for j in joints]),
        slides=np.array([is_slide(model, j) for j in joints]),
        zero=model.qpos0[adr].copy(),
        range=np.where(model.jnt_limited[list(joints)][:, None], model.jnt_range[list(joints)], (-np.inf, np.inf)),
        inertial=inertial,
        gravity=model.opt.gravity.copy(),
        armature=model.dof_armature[dof].copy(),
        damping=linear_part(model.dof_damping, model.nv)[dof],
        frictionloss=model.dof_frictionloss[dof].copy(),
        creep=creep_speeds(model, dof),
        stiffness=linear_part(model.jnt_stiffness, model.njnt)[list(joints)],
        rest=model.qpos_spring[adr].copy(),
        tendons=tendons_of(model, joints),
    )


def tendons_of(model: Any, joints: Sequence[int]) -> Tendons:
    """The fixed tendons of a compiled model over its joints `joints`; spatial tendons are left out."""
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


def _check(model: Any, joints: list[int], arm: RigidArm, label: str) -> None:
    """Compare with mj_inverse at random states. Raises BadInput for a model with parts that the chain leaves out."""
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    adr, dof = model.jnt_qposadr[list(joints)], model.jnt_dofadr[list(joints)]
    bits = mujoco.mjtDisableBit
    without = int(bits.mjDSBL_CONSTRAINT) | int(bits.mjDSBL_CONTACT) | int(bits.mjDSBL_LIMIT)
    flags, model.opt.disableflags = model.opt.disableflags, model.opt.disableflags | without
    kept = (model.dof_frictionloss, model.tendon_frictionloss, model.body_gravcomp)  # the last is the controller's
    losses = [(loss, loss.copy()) for loss in kept]
    for loss, _ in losses:
        loss[:] = 0.0
    arm = replace(arm, tendons=replace(arm.tendons, frictionloss=0.0 * arm.tendons.frictionloss))
    try:
        q, v, a = (random.uniform(-1, 1, (3, arm.n)) for _ in range(3))
        for row in range(3):
            data.qpos[:], data.qvel[:], data.qacc[:] = model.qpos0, 0.0, 0.0
            data.qpos[adr], data.qvel[dof], data.qacc[dof] = q[row], v[row], a[row]
            mujoco.mj_inverse(model, data)
            ours = arm.carried(q[row : row + 1], v[row : row + 1], a[row : row + 1])[0]
            ours += arm.nominal_joint_torque(v[row], a[row], np.zeros(arm.n))
            worst = int(np.argmax(np.abs(ours - data.qfrc_inverse[dof])))
            if abs(ours[worst] - data.qfrc_inverse[dof][worst]) > 1e-6 * (1.0 + np.abs(ours).max()):
                raise BadInput(
                    f"{label}: joint {arm.names[worst]}: the model's torque is {data.qfrc_inverse[dof][worst]:.6g} "
                    f"N·m, but the torque of its rigid chain is {ours[worst]:.6g} N·m: expected a plain chain of "
                    "joints (no springs between joints, fluid forces or joint equalities)"
                )
    finally:
        model.opt.disableflags = flags
        for loss, was in losses:
            loss[:] = was


@contextmanager
def silent() -> Iterator[None]:
    """MuJoCo writes no log of the simulations that break loose."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
