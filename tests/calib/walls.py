"""Walls in the space of the joints, which stand for the geometry of an arm, and the commands that an arm gets."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from armlink.link.link import Link
from calib.plan.collisions import Contact
from gcomp.arrays import Array, Mask


class Watched:
    """An enabled link, and what it was commanded."""

    def __init__(self, link: Link) -> None:
        self.link, self.kept = link, list[Array]()
        cycle, play = link.cycle, link.play

        def cycled(command: Any) -> Any:
            self.kept.append(command.position.copy())
            return cycle(command)

        def played(setpoints: Any) -> Any:
            self.kept.extend(setpoints.position)
            return play(setpoints)

        link.cycle, link.play = cycled, played  # type: ignore[method-assign]


class Walls:
    """Geometry of which the test says where it touches: around the middles of ways, in the space of the joints."""

    def __init__(self, *ways: tuple[Array, Array]) -> None:
        self.middles = [(begin + end) / 2 for begin, end in ways]

    def free(self, poses: Array) -> Mask:
        return np.all([np.linalg.norm(poses - each, axis=1) > 0.15 for each in self.middles], axis=0)

    def contacts(self, pose: Array) -> list[Contact]:
        return [] if self.free(pose[None])[0] else [Contact(("post", "fore"), 0.01)]

    def way(self, begin: Array, end: Array, *, standing: bool = False) -> Iterator[tuple[Array, list[Contact]]]:
        return ((pose, self.contacts(pose)) for pose in np.linspace(begin, end, 100)[int(standing) :])
