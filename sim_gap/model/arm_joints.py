"""Which hinges of a compiled model are the arm's: those on one chain, without a hand and coupled joints at its end."""

from typing import Any

from armlink.errors import BadInput
from gcomp.arm.model_file import HAND, coupled_joints, upwards


def hinges_of(model: Any) -> dict[str, int]:
    """Hinges of a compiled model by name, in its order."""
    import mujoco

    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    return {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j + 1}": j for j in hinges}


def hinges_between(model: Any, base: str | None, tip: str | None) -> dict[str, int]:
    """Hinges that body `base` carries (default: the world) on the way to body `tip` (default: all). Raises BadInput."""
    if base is None and tip is None:
        return hinges_of(model)
    first = 0 if base is None else _body(model, base, "base")
    last = None if tip is None else upwards(model, _body(model, tip, "tip"))
    if last is not None and first not in last:
        raise BadInput(f"--base {base} --tip {tip}: the one does not carry the other: give the bodies of one arm")
    found = {}
    for name, joint in hinges_of(model).items():
        body = int(model.jnt_bodyid[joint])
        if first in upwards(model, body)[1:] and (last is None or body in last):
            found[name] = joint
    if not found:
        raise BadInput(f"--base {base or 'world'} --tip {tip or 'any'}: no hinge between them")
    return found


def arm_hinges(model: Any, hinges: dict[str, int], label: str) -> dict[str, int]:
    """The longest chain of some hinges, without coupled joints and those of a hand at its end.

    Raises BadInput for several chains of that length, as of a model with two arms.
    """
    coupled = coupled_joints(model)
    ways: list[list[str]] = []
    for tip in hinges.values():
        carriers = set(upwards(model, int(model.jnt_bodyid[tip])))
        way = [name for name, joint in hinges.items() if int(model.jnt_bodyid[joint]) in carriers]
        while way and (way[-1] in coupled or HAND.search(way[-1])):
            way.pop()
        if way not in ways:
            ways.append(way)
    longest = max(map(len, ways), default=0)
    arms = [way for way in ways if len(way) == longest]
    if longest and len(arms) > 1:
        tips = ", ".join(model.body(int(model.jnt_bodyid[hinges[way[-1]]])).name for way in arms)
        raise BadInput(
            f"{label}: has {len(arms)} arms of {longest} joints: name the body that it ends in, --tip: {tips}"
        )
    return {name: hinges[name] for way in arms for name in way}


def _body(model: Any, name: str, option: str) -> int:
    import mujoco

    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name))
    if body < 0:
        names = ", ".join(model.body(each).name for each in range(1, model.nbody))
        raise BadInput(f"--{option} {name}: no such body in the model; there are {names}")
    return body
