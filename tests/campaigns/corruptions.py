"""Ways in which the mapping, the units and the clocks of a recording go wrong, each drawn at random."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from armlink.recording.recording import Recording, slice_rows, take_joints

Array = np.ndarray
Corruption = Callable[[Recording, np.random.Generator], Recording | None]
"""The spoiled recording; None where the recording has not what would be spoiled."""


def torque_channel(recording: Recording) -> str:
    return "torque" if recording.torque is not None else "motor_torque"


def with_torque(recording: Recording, change: Callable[[Array], Array]) -> Recording:
    name = torque_channel(recording)
    return replace(recording, **{name: change(getattr(recording, name).copy())})


def with_positions(recording: Recording, change: Callable[[Array], Array]) -> Recording:
    """Positions, and the velocities that a driver derives from the same encoder, changed alike."""
    velocity = None if recording.velocity is None else change(recording.velocity.copy())
    return replace(recording, position=change(recording.position.copy()), velocity=velocity)


def some(recording: Recording, random: np.random.Generator, count: int = 1) -> list[int]:
    return random.choice(recording.n, count, replace=False).tolist()


def factors(recording: Recording, joints: Sequence[int], factor: float | Array) -> Array:
    made = np.ones(recording.n)
    made[list(joints)] = factor
    return made


def one_sign(recording: Recording, random: np.random.Generator) -> Recording:
    sign = factors(recording, some(recording, random), -1.0)
    return with_torque(recording, lambda y: y * sign)


def position_sign(recording: Recording, random: np.random.Generator) -> Recording:
    sign = factors(recording, some(recording, random), -1.0)
    return with_positions(recording, lambda x: x * sign)


def one_in_degrees(recording: Recording, random: np.random.Generator) -> Recording:
    unit = factors(recording, some(recording, random), 180.0 / np.pi)
    return with_positions(recording, lambda x: x * unit)


def constants(recording: Recording, random: np.random.Generator) -> Array:
    """Torque constants at the joints of drives: a gear in them, or without one."""
    bounds = (8.0, 20.0) if random.random() < 0.5 else (0.02, 0.3)
    return random.uniform(*bounds, recording.n)


def amperes(recording: Recording, random: np.random.Generator) -> Recording:
    unit = constants(recording, random)
    return with_torque(recording, lambda y: y / unit)


def amperes_of_one(recording: Recording, random: np.random.Generator) -> Recording:
    unit = factors(recording, joints := some(recording, random), constants(recording, random)[joints[0]])
    return with_torque(recording, lambda y: y / unit)


def before_the_gear(recording: Recording, random: np.random.Generator) -> Recording:
    ratio = random.choice([50.0, 100.0, 101.0, 120.0, 160.0], recording.n)
    return with_torque(recording, lambda y: y / ratio)


def unsigned_one(recording: Recording, random: np.random.Generator) -> Recording:
    joint = some(recording, random)

    def change(y: Array) -> Array:
        y[:, joint] = np.abs(y[:, joint])
        return y

    return with_torque(recording, change)


def shuffled(count: int) -> Callable[[Recording, np.random.Generator], list[int]]:
    """Order in which so many columns are in other places, each."""

    def order(recording: Recording, random: np.random.Generator) -> list[int]:
        chosen, made = some(recording, random, min(count, recording.n)), list(range(recording.n))
        for place, other in zip(chosen, [*chosen[1:], chosen[0]], strict=True):
            made[place] = other
        return made

    return order


def in_order(count: int, what: str) -> Corruption:
    """Columns of `all` channels, of the positions or of the `torque` exchanged between so many joints."""
    draw = shuffled(count)

    def spoil(recording: Recording, random: np.random.Generator) -> Recording:
        order = draw(recording, random)
        if what == "torque":
            return with_torque(recording, lambda y: y[:, order])
        if what == "positions":
            return with_positions(recording, lambda x: x[:, order])
        return take_joints(recording, order, recording.names)

    return spoil


def swapped_midway(recording: Recording, random: np.random.Generator) -> Recording:
    order, rows = shuffled(2)(recording, random), recording.t > recording.t[0] + 0.5 * np.ptp(recording.t)
    name = torque_channel(recording)
    values = getattr(recording, name).copy()
    values[rows] = values[rows][:, order]
    return replace(recording, **{name: values})


def zero(recording: Recording, random: np.random.Generator) -> Recording:
    position = recording.position.copy()
    position[:, random.integers(1, recording.n)] += random.choice([0.5 * np.pi, -0.5 * np.pi, np.pi])
    return replace(recording, position=position)


def small_zero(recording: Recording, random: np.random.Generator) -> Recording:
    position = recording.position.copy()
    position[:, random.integers(1, recording.n)] += random.choice([-1.0, 1.0]) * random.uniform(0.1, 0.3)
    return replace(recording, position=position)


def effort(recording: Recording, _: np.random.Generator) -> Recording | None:
    return (
        None if recording.motor_torque is None else replace(recording, torque=recording.motor_torque, motor_torque=None)
    )


def late(shortest: float, longest: float) -> Corruption:
    """Torques that are stamped late, or early, by a constant [s]."""

    def spoil(recording: Recording, random: np.random.Generator) -> Recording:
        by = random.choice([-1.0, 1.0]) * random.uniform(shortest, longest)
        return with_torque(
            recording, lambda y: np.column_stack([np.interp(recording.t - by, recording.t, x) for x in y.T])
        )

    return spoil


def received(recording: Recording, scatter: Array) -> Recording:
    times = np.maximum.accumulate(recording.t + scatter)
    return replace(recording, t=times + 1e-9 * np.arange(recording.t.size))


def jitter(recording: Recording, random: np.random.Generator) -> Recording:
    period = float(np.median(np.diff(recording.t)))
    return received(recording, np.abs(random.normal(0.0, 0.6 * period, recording.t.size)))


def bursts(recording: Recording, random: np.random.Generator) -> Recording:
    """Rows that wait in a buffer now and then and are stamped together."""
    period = float(np.median(np.diff(recording.t)))
    number = np.arange(recording.t.size)
    length = int(random.integers(4, 9))
    return received(recording, (length - 1 - number % length) * period)


def held(recording: Recording, random: np.random.Generator) -> Recording:
    """Positions that are read every few rows only, and repeated between."""
    rows = np.arange(recording.t.size) // (k := int(random.integers(3, 8))) * k
    return with_positions(recording, lambda x: x[rows])


def repeats(recording: Recording, random: np.random.Generator) -> Recording:
    rows = np.arange(recording.t.size)
    rows[1:] -= random.random(rows.size - 1) < 0.15
    return replace(recording, **{name: values[rows] for name, values in recording.channels().items()})


def dropped(recording: Recording, random: np.random.Generator) -> Recording:
    return slice_rows(recording, random.random(recording.t.size) > 0.3)


def glued(recording: Recording, random: np.random.Generator) -> Recording:
    """A piece in the middle is lost, and the clock does not show it."""
    share = random.uniform(0.1, 0.3)
    t = (recording.t - recording.t[0]) / np.ptp(recording.t)
    left = slice_rows(recording, (t < 0.5 - share) | (t > 0.5 + share))
    return replace(left, t=recording.t[: left.t.size])


def backwards(recording: Recording, random: np.random.Generator) -> Recording:
    """The clock is set back in some place."""
    t = recording.t.copy()
    t[int(random.uniform(0.2, 0.8) * t.size) :] -= random.uniform(0.5, 5.0)
    return replace(recording, t=t)


def rounded(recording: Recording, random: np.random.Generator) -> Recording | None:
    """Times to the hundredth of a second, of rows that come faster; to four periods in slower recordings."""
    step = max(0.01, 4.0 * float(np.median(np.diff(recording.t))))
    t = np.floor(recording.t / step) * step
    return replace(recording, t=t) if random.random() < 0.5 else replace(recording, t=t + 1e-9 * np.arange(t.size))


def timed(factor: float) -> Corruption:
    return lambda recording, _: replace(recording, t=recording.t * factor)


def counts(recording: Recording, random: np.random.Generator) -> Recording:
    per_rad = random.choice([1024, 4096, 16384, 2**17, 2**20]) / (2.0 * np.pi)
    velocity = None if recording.velocity is None else recording.velocity * per_rad
    return replace(recording, position=np.round(recording.position * per_rad), velocity=velocity)


def of_velocity(change: Callable[[Recording, Array, np.random.Generator], Array]) -> Corruption:
    """A change of the velocities alone."""
    return lambda recording, random: (
        None
        if recording.velocity is None
        else replace(recording, velocity=change(recording, recording.velocity.copy(), random))
    )


def velocity_filtered(recording: Recording, velocity: Array, random: np.random.Generator) -> Array:
    slow = 1.0 - np.exp(-np.median(np.diff(recording.t)) / random.uniform(0.05, 0.4))
    return np.asarray(lfilter([slow], [1.0, slow - 1.0], velocity, axis=0))


CORRUPTIONS: dict[str, Corruption] = {
    "sign of one torque": one_sign,
    "sign of all torques": lambda recording, _: with_torque(recording, lambda y: -y),
    "sign of a position": position_sign,
    "degrees": lambda recording, _: with_positions(recording, np.degrees),
    "degrees, dq in rad/s": lambda recording, _: replace(recording, position=np.degrees(recording.position)),
    "degrees of one joint": one_in_degrees,
    "amperes": amperes,
    "amperes of one joint": amperes_of_one,
    "mN·m": lambda recording, _: with_torque(recording, lambda y: 1e3 * y),
    "torque before the gear": before_the_gear,
    "unsigned": lambda recording, _: with_torque(recording, np.abs),
    "unsigned at one joint": unsigned_one,
    "joints exchanged": in_order(2, "all"),
    "three joints permuted": in_order(3, "all"),
    "all joints permuted": in_order(9, "all"),
    "torques exchanged": in_order(2, "torque"),
    "three torques permuted": in_order(3, "torque"),
    "all torques permuted": in_order(9, "torque"),
    "positions exchanged": in_order(2, "positions"),
    "all positions permuted": in_order(9, "positions"),
    "torques swapped midway": swapped_midway,
    "reverse order": lambda recording, _: take_joints(recording, list(range(recording.n))[::-1], recording.names),
    "zero": zero,
    "small zero": small_zero,
    "effort": effort,
    "skew": late(0.2, 1.0),
    "small skew": late(0.01, 0.2),
    "jitter": jitter,
    "bursts": bursts,
    "held": held,
    "repeats": repeats,
    "dropped": dropped,
    "glued": glued,
    "clock set back": backwards,
    "rounded times": rounded,
    "milliseconds": timed(1e3),
    "microseconds": timed(1e6),
    "nanoseconds": timed(1e9),
    "encoder counts": counts,
    "velocity filtered": of_velocity(velocity_filtered),
    "velocity in degrees": of_velocity(lambda _, v, __: np.degrees(v)),
    "velocity order": of_velocity(lambda _, v, __: v[:, ::-1]),
}
