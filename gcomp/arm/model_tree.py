"""The tree of a compiled MuJoCo model: what carries a body, which joints are coupled, which belong to a hand."""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

HAND = re.compile(r"grip|finger|hand|jaw|thumb|claw", re.IGNORECASE)
"""Names of joints that grasp rather than move the arm."""


def upwards(model: "mujoco.MjModel", body: int) -> list[int]:
    """The body and those that carry it, up to the world."""
    found = [body]
    while found[-1]:
        found.append(int(model.body_parentid[found[-1]]))
    return found


def coupled_joints(model: "mujoco.MjModel") -> dict[str, str]:
    """Joint → joint that an equality couples it with (mimic joints), both ways."""
    import mujoco

    pairs: dict[str, str] = {}
    for equality in range(model.neq):
        if model.eq_type[equality] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[equality] >= 0:
            first, second = (model.joint(int(each[equality])).name for each in (model.eq_obj1id, model.eq_obj2id))
            pairs |= {first: second, second: first}
    return pairs
