"""An arm of two joints on vcan0, for processes that share one core of a user-mode kernel."""

from contextlib import contextmanager

from armlink.bus.open import open_bus

PAIR = """
name: pair
kinematics:
  joints:
    - {{name: joint_1, alpha: 1.5707963, d: 0.2, lower: -2.0, upper: 2.0}}
    - {{name: joint_2, a: 0.3, lower: -2.0, upper: 2.0}}
link:
  bus: {{interface: socketcan, channel: vcan0, bitrate: 1000000}}
  rate: 50
  deadline: {deadline}
  joints:
    - {{name: joint_1, node: 11, rated_torque: 40.0, max_torque: 30.0{first}}}
    - {{name: joint_2, node: 12, rated_torque: 40.0, max_torque: 30.0{second}}}
sim:
  links:
    - {{mass: 2.0, com: [0.0, 0.0, 0.05], inertia: [0.01, 0.01, 0.01]}}
    - {{mass: 1.0, com: [0.1, 0.0, 0.0], inertia: [0.01, 0.01, 0.01]}}
  sensors: {{gain: [1.1, 1.0], offset: [0.0, 1.0], position_gain: [1.0, 1.0], noise: [0.01, 0.01], bits: 16}}
"""


def pair_text(deadline: float, *fastest: float | None) -> str:
    """The arm file: link.deadline [s], and max_velocity of each joint [rad/s], None where the file states none."""
    first, second = ("" if speed is None else f", max_velocity: {speed}" for speed in fastest)
    return PAIR.format(deadline=deadline, first=first, second=second)


@contextmanager
def opened(section):
    """The bus of a section, until the block ends."""
    bus = open_bus(None, section)
    try:
        yield bus
    finally:
        bus.shutdown()
