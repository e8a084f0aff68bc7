"""Values of a nominal model, and the model with other values: what adapters share that answer MuJoCo's quantities."""

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np

from referee.interface import Case, Parameter, target

QUANTITIES = ("frictionloss", "damping", "armature", "kp")
"""`damping` is the joint's, and with positions alone the servo's too, since a position cannot tell them."""


def allowed(case: Case, quantities: Iterable[str]) -> list[str]:
    """The quantities that a tool may estimate in this case."""
    words = {quantity: "payload" if quantity == "mass" else quantity for quantity in quantities}
    return [
        quantity for quantity, word in words.items() if target(word, "mujoco").partition(":")[0] not in case.withheld
    ]


def spec_of(case: Case) -> Any:
    """The model; with positions alone its servos' damping is the joints' damping."""
    spec = mujoco.MjSpec.from_file(str(case.model))
    if case.kind == "positions":
        for servo in spec.actuators:
            spec.joint(servo.target).damping[0] -= servo.biasprm[2]
            servo.biasprm[2] = 0.0
    return spec


def value_of(spec: Any, quantity: str, joint: str) -> float:
    if quantity == "kp":
        return float(servo_of(spec, joint).gainprm[0])
    if quantity == "mass":
        return float(spec.joint(joint).parent.mass)
    value = getattr(spec.joint(joint), quantity)
    return float(value[0] if quantity == "damping" else value)


def put(spec: Any, quantity: str, joint: str, value: float) -> None:
    """Write a value into a model; `mass` is that of the joint's link."""
    if quantity == "kp":
        servo = servo_of(spec, joint)
        servo.gainprm[0], servo.biasprm[1] = value, -value
    elif quantity == "damping":
        spec.joint(joint).damping[0] = value
    elif quantity == "mass":
        spec.joint(joint).parent.mass = value
    else:
        setattr(spec.joint(joint), quantity, value)


def servo_of(spec: Any, joint: str) -> Any:
    return next(servo for servo in spec.actuators if servo.target == joint)


def driven(case: Case, step_s: float) -> Any:
    """The model for roll-outs: an actuator named after each joint, in their order: its servo, or one for torque."""
    spec = spec_of(case)
    for old in list(spec.actuators) if case.kind != "positions" else ():
        spec.delete(old)
    for joint in case.joints:
        if case.kind == "positions":
            servo_of(spec, joint).name = joint
        else:
            spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    spec.option.timestep = step_s
    return spec


def largest(case: Case) -> Any:
    """Largest torque of each joint in training [N·m]; of a servo, what it makes of its largest error."""
    if case.kind != "positions":
        return np.max([np.abs(r.torque).max(0) for r in case.train], axis=0)
    spec = spec_of(case)
    gains = [value_of(spec, "kp", joint) for joint in case.joints]
    return np.max([np.abs(r["q_cmd"] - r["q"]).max(0) for r in case.train], axis=0) * gains


def corrected(case: Case, values: Mapping[tuple[str, str], float], inertial: Any = None) -> str:
    """MJCF text of the model with these values, by quantity and joint, and links with other inertial parameters (mass,
    first moment, inertia about the link's frame, ten a joint as Pinocchio has them) where a body can have them."""
    spec = spec_of(case)
    for (quantity, joint), value in values.items():
        put(spec, quantity, joint, value)
    for joint, (mass, *rest) in zip(
        case.joints, np.reshape([] if inertial is None else inertial, (-1, 10)), strict=False
    ):
        moment, (xx, xy, yy, xz, yz, zz) = np.array(rest[:3]), rest[3:]
        if mass > 0.0:
            com = moment / mass
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            inertia -= mass * (com @ com * np.eye(3) - np.outer(com, com))
            small, middle, large = np.linalg.eigvalsh(inertia)
            if small > 0.0 and large < small + middle:
                _set_inertial(spec.joint(joint).parent, mass, com, inertia)
    spec.compile()
    return str(spec.to_xml())


def _set_inertial(body: Any, mass: float, com: Any, inertia: Any) -> None:
    body.mass, body.ipos, body.explicitinertial = mass, com, True
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.inertia, body.iquat = np.zeros(3), [1.0, 0.0, 0.0, 0.0]


def parameters(case: Case, values: Mapping[tuple[str, str], float], half: Mapping[tuple[str, str], float]) -> list[Any]:
    """Parameters of an answer, with half widths of intervals where there are any; a link's mass is a
    payload."""
    spec, out = spec_of(case), []
    for (quantity, joint), value in values.items():
        nominal, width = value_of(spec, quantity, joint), half.get((quantity, joint))
        ends = (None, None) if width is None else (value - width, value + width)
        if quantity == "mass":
            more = (None if x is None else x - nominal for x in ends)
            out.append(Parameter("payload", "", value - nominal, *more, 0.0))
        else:
            out.append(Parameter(quantity, joint, value, *ends, nominal))
    return out
