"""The second plant: MuJoCo as its users run it, with its own friction, servos and integrator (`simulated_elsewhere`).

Arms are drawn ones, published ones where a folder has them, and pendulums with one servo, as those who identify
servos use them.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sim_gap.blind.arms import compile_arm, controlled_inertia, draw_arm, mjcf

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "campaigns"))
import simulated_elsewhere as elsewhere

SERVO_HZ, DAMPING_RATIO = (4.0, 7.0), (0.6, 1.0)
"""Range of a joint's natural frequency under its servo, and of its damping ratio."""
REACH = 0.3
"""Share of a joint's range on either side of its middle that drawn motion uses."""
TORQUE_EVERY, POSITION_EVERY = 5, 10
"""Steps of 2 ms from row to row."""
SECONDS = 15.0
"""Length of a recording; there are two for training."""
PENDULUM = """<mujoco model="pendulum"><compiler angle="radian"/><option timestep="0.002" gravity="0 0 -9.81"/>
<worldbody><body name="rod"><joint name="servo" type="hinge" axis="0 1 0" armature="{armature:.9g}"
damping="{damping:.9g}" frictionloss="{friction:.9g}"/><inertial pos="0 0 {centre:.9g}" mass="{mass:.9g}"
diaginertia="{across:.9g} {across:.9g} 1e-5"/></body></worldbody><actuator><position name="servo" joint="servo"
kp="{kp:.9g}" kv="{kv:.9g}"/></actuator></mujoco>"""
"""A rod of negligible mass, which points down at angle zero, with a weight at its end."""


@dataclass(frozen=True)
class Drawn:
    """A nominal arm in MuJoCo, and the limits of its motion."""

    spec: Callable[[], Any]
    arm: elsewhere.Arm


def draw_nominal(random: np.random.Generator, pendulum: bool, torques: bool, models: Path | None) -> Drawn:
    """A pendulum, a drawn arm, or with torques in one of two cases a published arm of the folder `models`.

    Arms whose positions alone are recorded have two or three joints, as those of the first plant."""
    if pendulum:
        return _pendulum(random)
    if torques and models is not None and random.random() < 0.5:
        arm = elsewhere.ARMS[str(random.choice(list(elsewhere.ARMS)))]
        text = elsewhere.nominal(arm, models).to_xml()
        return Drawn(lambda: mujoco.MjSpec.from_string(text), arm)
    drawn = draw_arm(random, int(random.integers(3, 7) if torques else random.integers(2, 4)))
    inertia = controlled_inertia(compile_arm(drawn), random.uniform(drawn.lower, drawn.upper, (16, drawn.n)))
    pulse = 2.0 * np.pi * random.uniform(*SERVO_HZ, drawn.n)
    kp, kv = inertia * pulse**2, 2.0 * random.uniform(*DAMPING_RATIO, drawn.n) * inertia * pulse
    middle, span = 0.5 * (drawn.lower + drawn.upper), REACH * (drawn.upper - drawn.lower)
    ends = (tuple((middle + side * span).tolist()) for side in (-1.0, 1.0))
    arm = elsewhere.Arm("", tuple(kp.tolist()), tuple(kv.tolist()), tuple(drawn.armature.tolist()), *ends)
    servos = [
        f'<position name="servo_{name}" joint="{name}" kp="{a:.9g}" kv="{b:.9g}"/>'
        for name, a, b in zip(drawn.names, arm.gains, arm.dampings, strict=True)
    ]
    text = mjcf(drawn, ["<actuator>", *servos, "</actuator>"])

    def spec() -> Any:
        made = mujoco.MjSpec.from_string(text)
        made.option.timestep = elsewhere.STEP_S
        return made

    return Drawn(spec, arm)


def _pendulum(random: np.random.Generator) -> Drawn:
    mass, length = random.uniform(0.3, 1.2), random.uniform(0.1, 0.2)
    inertia = mass * length**2 + (armature := random.uniform(0.01, 0.03))
    pulse = 2.0 * np.pi * random.uniform(*SERVO_HZ)
    kp, kv = inertia * pulse**2, 1.6 * inertia * pulse
    text = PENDULUM.format(
        armature=armature, damping=0.02, friction=0.05, centre=-length, mass=mass, across=1e-5, kp=kp, kv=kv
    )
    return Drawn(lambda: mujoco.MjSpec.from_string(text), elsewhere.Arm("", (kp,), (kv,), (armature,), (-1.5,), (1.5,)))


def drag(spec: Any, j: int, random: np.random.Generator) -> None:
    """Damping that grows with speed, as in oil: outside of every library."""
    spec.joints[j].damping[1] = -spec.actuators[j].biasprm[2] * random.uniform(0.5, 1.0)


def cord(spec: Any, j: int, random: np.random.Generator) -> None:
    """An elastic cord from the hand to a point in the room: outside of every library."""
    strength, data = 0.05 * spec.actuators[0].gainprm[0], mujoco.MjData(model := spec.compile())
    mujoco.mj_forward(model, data)
    hand = data.xpos[-1] + random.normal(0.0, 0.3, 3)
    last = list(spec.joints)[-1].parent
    last.add_site(name="hand_", pos=[0.0, 0.0, 0.02])
    spec.worldbody.add_site(name="hook_", pos=hand)
    tendon = spec.add_tendon(name="cord_", stiffness=strength, springlength=[0.0, 0.1])
    tendon.wrap_site("hand_")
    tendon.wrap_site("hook_")


OUTSIDE: dict[str, Callable[[Any, int, np.random.Generator], None]] = {"drag": drag, "cord": cord}
NEAREST = {"drag": ("friction.viscous",), "cord": ("transmission.spring",)}
"""Effects that are no wrong name for these laws."""
EVERY = elsewhere.BODIES | elsewhere.JOINTS | elsewhere.SERVOS


def effects_shown(torques: bool, bodies: bool) -> list[str]:
    """Effects that such a recording can show."""
    return list(elsewhere.BODIES if bodies else elsewhere.JOINTS if torques else elsewhere.JOINTS | elsewhere.SERVOS)


def apply(spec: Any, effect: str, joint: int, random: np.random.Generator) -> None:
    (EVERY | OUTSIDE)[effect](spec, joint, random)


def record(drawn: Drawn, spec: Any, random: np.random.Generator, reaching: bool, torques: bool) -> Any:
    every = TORQUE_EVERY if torques else POSITION_EVERY
    given = elsewhere.commands(drawn.arm, round(SECONDS / elsewhere.STEP_S), random, reaching)
    noise = elsewhere.NOISE_RAD[0]
    return elsewhere.recorded(spec, drawn.arm, given, every * elsewhere.STEP_S, random, noise, torques)


def totals(spec: Any, torques: bool) -> dict[str, list[float]]:
    """What each joint has, by effect and quantity. A servo's damping belongs to the motor's torque where that is
    recorded, and to the joint where it is not."""
    joints = list(spec.joints)
    kv = [0.0] * len(joints) if torques else [-float(servo.biasprm[2]) for servo in spec.actuators]
    out = {
        "friction.coulomb:torque": [float(joint.frictionloss) for joint in joints],
        "friction.viscous:damping": [float(joint.damping[0]) + b for joint, b in zip(joints, kv, strict=True)],
        "actuator.rotor_inertia:inertia": [float(joint.armature) for joint in joints],
        "transmission.spring:stiffness": [float(joint.stiffness[0]) for joint in joints],
    }
    if not torques:
        out["controller.stiffness:kp"] = [float(servo.gainprm[0]) for servo in spec.actuators]
        out["controller.delay:time"] = [float(servo.delay) for servo in spec.actuators]
    return out
