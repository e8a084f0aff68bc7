"""Which torque channels a data set has, and what each joint's reading is compared with."""

from dataclasses import dataclass

import numpy as np

from gcomp.arrays import Array
from sim_gap.residuals.preprocess import PreparedSignals

Row = tuple[str, int]
"""A channel and the index of a joint: one residual over time."""
Columns = dict[Row, Array]
"""Columns of a linear term at each row that it touches, one per coefficient, (K, p)."""
FLOOR, FLOOR_INNER, FLOOR_NM = 0.01, 0.003, 0.01
"""Error granted to every arm, and so a residual that is not worth a parameter: share of a joint's torque (RMS) against
the model, and of motor against sensor or command; and in any case [N·m]."""
QUIETER = 0.5
"""A noisy motor estimate is passed over if the next reference has less than this share of its uncertainty."""


@dataclass(frozen=True)
class ChannelLayout:
    """The channels of a data set and the reference of each row.

    The sensor row of a joint is `tau` − model. With a sensor, the motor row is `tau_motor` − `tau`, in which errors of
    the links do not show; without one, it is `tau_motor` − model. The command row is `tau_cmd` − `tau_motor`, or, at a
    joint whose motor estimate is noisy, `tau_cmd` − `tau` or − model (`passed_over`).
    """

    n: int
    sensor: str | None
    motor: str | None
    command: str | None = None
    passed_over: tuple[int, ...] = ()
    """Number of channels that each joint's command passes over: 0 compares with the motor channel, 1 with the next one,
    then the model; empty is 0 for every joint."""

    @property
    def rows(self) -> tuple[Row, ...]:
        """All residuals: sensor rows first, base to tip, then motor rows, then command rows."""
        channels = [channel for channel in (self.sensor, self.motor, self.command) if channel]
        return tuple((channel, joint) for channel in channels for joint in range(self.n))

    @property
    def against_model(self) -> str:
        """The channel in which errors of links and positions show: the sensor's, else the motor's."""
        return str(self.sensor or self.motor)

    @property
    def motor_side(self) -> str:
        """The channel in which friction shows: the motor's, else the sensor's."""
        return str(self.motor or self.sensor)

    @property
    def commanded(self) -> str | None:
        """The channel that shows how the drives follow their command: the command's, or a command taken for the motor's
        torque; None without either."""
        return self.command or ("tau_cmd" if self.motor == "tau_cmd" else None)

    @property
    def chain(self) -> tuple[str, ...]:
        return tuple(channel for channel in (self.motor, self.sensor) if channel)

    def beyond(self, joint: int) -> int:
        """Number of channels of the chain that the joint's command passes over."""
        return self.passed_over[joint] if self.passed_over else 0

    def reference(self, row: Row) -> str | None:
        """The channel that a row is compared with; None is the model."""
        chain: tuple[str | None, ...] = (*((self.command,) if self.command else ()), *self.chain, None)
        ahead = self.beyond(row[1]) if row[0] == self.command else 0
        return chain[chain.index(row[0]) + 1 + ahead]

    def compared(self, rows: Columns) -> Columns:
        """Columns (or residuals), each channel against the next, as they are against the rows' references."""
        out = dict(rows)
        for joint in range(self.n if self.command else 0):
            parts = [(channel, joint) for channel in (self.command, *self.chain[: self.beyond(joint)]) if channel]
            present = [rows[part] for part in parts if part in rows]
            if present:
                out[str(self.command), joint] = np.sum(present, axis=0)
        return out

    def sensor_columns(self, joint: int, column: Array) -> Columns:
        """A term of the sensor's reading: positive in the sensor row, negative in motor − sensor."""
        if self.sensor is None:
            return {(self.motor_side, joint): column}
        out = {(self.sensor, joint): column}
        return out | ({(self.motor, joint): -column} if self.motor else {})


def layout_of(signals: list[PreparedSignals]) -> ChannelLayout:
    """The channels that all recordings have, and the best reference of each joint's command."""
    common = set.intersection(*(set(s.reading) for s in signals))
    sensor = "tau" if "tau" in common else None
    motor = next((channel for channel in ("tau_motor", "tau_cmd") if channel in common), None)
    command = "tau_cmd" if {"tau_motor", "tau_cmd"} <= common else None
    n = signals[0].n
    if command is None:
        return ChannelLayout(n, sensor, motor)
    torque = np.sqrt(np.mean([np.mean(s.model**2, axis=0) for s in signals], axis=0))
    doubts = [_noise(signals, "tau_motor"), FLOOR * torque]
    if sensor:
        doubts.insert(1, np.hypot(_noise(signals, sensor), FLOOR_INNER * torque))
    doubt = np.array(doubts)
    best = np.argmin(doubt, axis=0)
    clear = doubt[best, np.arange(n)] < QUIETER * doubt[0]
    return ChannelLayout(n, sensor, motor, command, tuple(np.where(clear, best, 0).tolist()))


def _noise(signals: list[PreparedSignals], channel: str) -> Array:
    """Noise of a channel that the command does not share, (n,): bounded by what their difference shows."""
    levels = [
        np.minimum(s.noise[channel], s.upper_half(s.filtered(s.reading["tau_cmd"] - s.reading[channel])))
        for s in signals
    ]
    return np.asarray(np.mean(levels, axis=0))
