"""Which hinges of a compiled model are the arm's: those on one chain, without a hand and coupled joints at its end."""

from typing import Any

from gcomp.arm.model_tree import HAND, coupled_joints, upwards


def hinges_of(model: Any) -> dict[str, int]:
    """Hinges of a compiled model by name, in its order."""
    import mujoco

    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    return {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j + 1}": j for j in hinges}


def arm_hinges(model: Any) -> dict[str, int]:
    """The longest chain of hinges, without coupled joints and those of a hand at its end."""
    hinges, coupled = hinges_of(model), coupled_joints(model)
    longest: list[str] = []
    for tip in hinges.values():
        carriers = set(upwards(model, int(model.jnt_bodyid[tip])))
        way = [name for name, joint in hinges.items() if int(model.jnt_bodyid[joint]) in carriers]
        while way and (way[-1] in coupled or HAND.search(way[-1])):
            way.pop()
        longest = max(longest, way, key=len)
    return {name: hinges[name] for name in longest}
