"""Which hinges of a compiled model are the arm's: those on one chain, without gripper and coupled joints."""

import re
from collections.abc import Sequence
from typing import Any

HAND = re.compile(r"grip|finger|hand|jaw|thumb|claw", re.IGNORECASE)
"""Names of joints that grasp rather than move the arm."""


def hinges_of(model: Any) -> dict[str, int]:
    """Hinges of a compiled model by name, in its order."""
    import mujoco

    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    return {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j + 1}": j for j in hinges}


def arm_hinges(model: Any, hinges: dict[str, int]) -> dict[str, int]:
    """The longest chain of hinges, without coupled joints and those of a hand at its end."""
    coupled = _coupled(model)
    chains = []
    for name in hinges:
        way = [
            n
            for n, j in hinges.items()
            if int(model.jnt_bodyid[j]) in _upwards(model, int(model.jnt_bodyid[hinges[name]]))
        ]
        while way and (way[-1] in coupled or HAND.search(way[-1])):
            way.pop()
        chains.append(way)
    longest = max(chains, key=len, default=[])
    return {name: hinges[name] for name in longest}


def _upwards(model: Any, body: int) -> Sequence[int]:
    """The body and those that carry it, up to the world."""
    found = [body]
    while found[-1]:
        found.append(int(model.body_parentid[found[-1]]))
    return found


def _coupled(model: Any) -> set[str]:
    """Joints that an equality couples with another: mimic joints, and the ones mimicked."""
    import mujoco

    names: set[str] = set()
    for equality in range(model.neq):
        if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[equality] >= 0:
            names |= {model.joint(int(each[equality])).name for each in (model.eq_obj1id, model.eq_obj2id)}
    return names
