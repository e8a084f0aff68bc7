"""Samples of an arm that another program commands, as they are heard; nothing is sent."""

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from armlink.arm_file import ArmFile
    from armlink.link.listener import Listener
    from armlink.link.types import Sample

Row = TypeVar("Row")
WAIT_SECONDS = 0.2
"""Longest wait for a sample, between two looks at the time [s]."""


def heard_samples(
    arm: "ArmFile", bus: str | None, seconds: float, row: "Callable[[Listener, Sample], Row]"
) -> Iterator[list[Row]]:
    """Rows that `row` makes from samples, until the time is over (0: no end) or Ctrl-C; one list for each batch.

    The list is empty if no sample came for a while. Raises BusFault if no sample comes at all.
    """
    from armlink.bus.listening.joint_messages import silence_of
    from armlink.bus.open import open_link_bus
    from armlink.errors import BusFault
    from armlink.link.listener import Listener

    opened = open_link_bus(bus, arm.require_link())
    heard = False
    with Listener(arm, opened) as listener, contextlib.suppress(KeyboardInterrupt):
        end = listener.clock.now() + (seconds or float("inf"))
        while (remaining := end - listener.clock.now()) > 0:
            together, sample = list[Row](), listener.next(min(remaining, WAIT_SECONDS))
            while sample is not None:
                heard = True
                together.append(row(listener, sample))
                sample = listener.next(0.0)
            yield together
        if not heard:
            why = silence_of(opened, f"no SYNC was heard: is a host running {arm.name}?")
            raise BusFault(f"{opened.channel_info}: {why}")
