"""Which joints of a model are the arm: the longest chain of driven revolute joints, without its gripper."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path

from armlink.errors import BadInput
from calib.commissioning.model_joints import ModelJoint
from gcomp.arm.model_file import HAND

OF_A_HAND = "belongs to the hand, according to its name"
"""Why a joint that grasps is set aside."""


@dataclass(frozen=True)
class Chain:
    """The joints of an arm, base to tip."""

    joints: tuple[ModelJoint, ...]
    aside: tuple[tuple[str, str], ...]
    """(Joint, why it is not a joint of the arm); each keeps the model's position."""
    base: str | None = None
    """Body that carries it; None for the world."""

    @property
    def tip(self) -> str:
        return self.joints[-1].body


def find_chains(
    joints: Sequence[ModelJoint], path: Path, base: str | None = None, tip: str | None = None
) -> list[Chain]:
    """The chains that an arm may be, best first: more than one for a model of several arms.

    With `base` and `tip`, those that are carried by that body, and the one that ends in this. Raises BadInput
    where there is none, naming the joint in the way.
    """
    if base is not None and not any(base in joint.carried_by for joint in joints):
        carriers = ", ".join(dict.fromkeys(name for joint in joints for name in reversed(joint.carried_by)))
        raise BadInput(f"{path}: --base {base}: there is no such body that carries a joint; there are {carriers}")
    if tip is not None:
        ends = [place for place, joint in enumerate(joints) if joint.body == tip]
        if not ends:
            moving = ", ".join(dict.fromkeys(joint.body for joint in joints))
            raise BadInput(f"{path}: --tip {tip}: there is no such body that moves; the bodies that move are {moving}")
        way = _after(joints, [*joints[ends[-1]].parents, ends[-1]], base)
        if not way:
            raise BadInput(f"{path}: --base {base} --tip {tip}: there is no revolute joint between these bodies")
        return [_chain(joints, way, path, base)]
    inner = {parent for joint in joints for parent in joint.parents}
    ways = []
    for leaf in (place for place in range(len(joints)) if place not in inner):
        way = _after(joints, [*joints[leaf].parents, leaf], base)
        whole = way
        while way and _aside(joints[way[-1]]):
            way = way[:-1]
        if not way and all(_aside(joints[place]) == OF_A_HAND for place in whole):
            way = whole  # a model of nothing but a finger is the arm itself
        if way and way not in ways:
            ways.append(way)
    if not ways:
        reasons = "; ".join(f"{joint.name} {_aside(joint)}" for joint in joints)
        raise BadInput(f"{path}: none of the joints of this model belongs to an arm: {reasons}")
    longest = max(map(len, ways))
    return [_chain(joints, way, path, base) for way in ways if len(way) == longest]


def _after(joints: Sequence[ModelJoint], way: list[int], base: str | None) -> list[int]:
    """Those of a way that `base` carries and that are not locked, from the first revolute one on.

    What carries the whole arm, such as a lift or a floating base, may be anywhere: it changes no joint's gravity.
    """
    free = [place for place in way if joints[place].locked is None]
    carried = [place for place in free if base is None or base in joints[place].carried_by]
    return list(dropwhile(lambda place: joints[place].kind in ("prismatic", "free"), carried))


def _aside(joint: ModelJoint) -> str | None:
    """Why a joint at the end of a chain is not one of the arm's, or None."""
    if joint.locked is not None:
        return f"is locked at {joint.locked:g}"
    if joint.kind != "revolute":
        return f"is {joint.kind}"
    if joint.partner is not None:
        return f"moves together with {joint.partner}"
    return OF_A_HAND if HAND.search(joint.name) else None


def _chain(joints: Sequence[ModelJoint], way: list[int], path: Path, base: str | None) -> Chain:
    chain = [joints[place] for place in way]
    carriers = [joints[place] for place in chain[0].parents if joints[place].locked is None]
    if base is None and carriers:
        base = carriers[-1].body
    for number, joint in enumerate(chain, start=1):
        if joint.kind != "revolute":
            raise BadInput(
                f"{path}: joint {joint.name or number} is {joint.kind} and lies between the base and the arm: begin "
                f"the arm after this joint (--base {joint.body}), or lock the joint (--lock {joint.name}:POSITION)"
            )
        if not joint.name:
            raise BadInput(
                f"{path}: joint {number} of the chain (body {joint.body!r}) has no name: name this joint in the model"
            )
    others = [joint for place, joint in enumerate(joints) if place not in way]
    aside = tuple((joint.name, _aside(joint) or "is not on the chain") for joint in others)
    if aside and not chain[-1].body:
        raise BadInput(
            f"{path}: the body of joint {chain[-1].name} has no name: name this body, so that the chain can end there"
        )
    return Chain(tuple(chain), aside, base)
