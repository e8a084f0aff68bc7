"""Prepares a recording: even sampling, smooth velocity and acceleration, model torque, one filter for data and model.

Every column that is compared with a reading passes through the same zero-phase low pass and decimation as the reading,
so that the filter does not change one against the other. Signs, plays and clips are evaluated at the work rate, before
that filter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import butter, sosfiltfilt, sosfreqz

from armlink.errors import BadInput
from armlink.recording.recording import Recording
from gcomp.arm.rigid_body import CREEP, LinkMotion, RigidArm, torque_slopes
from gcomp.arrays import Array, Mask
from sim_gap.residuals.channel_quality import (
    Disturbance,
    Spikes,
    Stuck,
    are_near_spikes,
    band_noise,
    count_spikes,
    spikes_of,
    stuck_intervals,
)

SLIDES, MOST_CREEP = 1.5, 0.2
"""Speed from which a joint of a simulation slides, over that up to which it creeps; the most that it is [rad/s]."""
BAND_HZ = 6.0
"""Pass band in which model and recording are compared [Hz]."""
SMOOTH_HZ = 20.0
"""Pass band of position and velocity before nonlinear functions are evaluated [Hz]."""
CALM_HZ = 8.0
"""Pass band of the model torque before a play or a clip is evaluated [Hz]."""
WORK_HZ = 125.0
"""Highest rate at which columns are computed [Hz]; faster recordings are low-passed and decimated to it."""
PAD_S = 1.0
"""Length of the reflection at either end of a signal that is filtered [s]."""
TRIM_S = 0.3
"""Length cut off at both ends after filtering [s]."""
SHORTEST_S, SHORTEST_PIECE_S = 3.0, 1.0
"""Least length of all recordings together, and of one of them with torques, whose ends are lost to a filter [s]."""
MOST_SAMPLES_PER_ROW = 100.0
"""Most even samples for each recorded row."""
ABSENT = -1
"""Number of a recording without the body that training recordings have."""
CHANNELS = {"tau": "torque", "tau_motor": "motor_torque", "tau_cmd": "torque_command"}


@dataclass(frozen=True, eq=False)
class PreparedSignals:
    """One recording at an even work rate, with the nominal model's torque along its motion."""

    label: str
    rate: float
    """Work rate [Hz]."""
    band: float
    """Pass band [Hz]."""
    t: Array
    q: Array
    v: Array
    a: Array
    """(K,), then (K, n) each in rad, rad/s, rad/s²."""
    reading: dict[str, Array]
    """Torque channels present, of `tau`, `tau_motor`, `tau_cmd` [N·m], (K, n)."""
    known: dict[str, Array]
    """1 for readings, 0 for samples interpolated over a gap or stuck, (K, n)."""
    noise: dict[str, Array]
    """Standard deviation of each channel's noise within the pass band [N·m], (n,)."""
    arm: RigidArm
    temperature: Array | None = None
    """Of each joint [°C], (K, n)."""
    number: int = 0
    """Number from 1 of the recording that this is (a part of), training recordings first; 0 if it has none, ABSENT if
    it is known to lack the body that others have."""
    groups: tuple[str, ...] = ()
    """Names of the groups of recordings with a common body that it belongs to."""
    mount: float = 0.0
    """Angle by which that body is turned about the last joint's axis, against the other recordings [rad]."""
    stuck: tuple[Stuck, ...] = ()
    """Channels that are stuck for some time, in which they are not `known`."""
    spikes: tuple[Spikes, ...] = ()
    """Channels with isolated spikes, which were interpolated; around them they are not `known`."""
    disturbances: tuple[Disturbance, ...] = ()
    """Moments at which something touched the arm, or torques were misread; there they are not `known`."""
    found: "Found | None" = None
    """The estimate's torques, if q, v, a and arm are those of the estimate."""

    @property
    def n(self) -> int:
        return int(self.q.shape[1])

    @cached_property
    def model(self) -> Array:
        """Torque of links and of springs across the joints [N·m], (K, n): the nominal model's, or the estimate's."""
        return self.arm.carried(self.q, self.v, self.a) if self.found is None else self.found.link

    @property
    def bodies(self) -> Array:
        """The share of `model` that masses have, without springs across the joints, (K, n)."""
        return self.model - (self.arm.spring_torque(self.q) if self.found is None else self.found.springs)

    @cached_property
    def smooth_model(self) -> Array:
        """Nominal torque without the noise of the accelerations, which would disturb plays and clips, (K, n)."""
        return self.calm(self.model)

    def calm(self, torque: Array) -> Array:
        """A torque (K, …) without what disturbs plays, clips and its acceleration."""
        return low_pass(min(CALM_HZ, 0.4 * self.rate), self.rate)(torque)

    @property
    def passed_on(self) -> Array:
        """The same with what the sensor has added up to where it is looked at, (K, n)."""
        return self.smooth_model if self.found is None else self.smooth_model + self.found.bent

    @cached_property
    def motor_model(self) -> Array:
        """Torque at the motor, with the model's own rotors and friction [N·m], (K, n)."""
        own = self.model + self.arm.nominal_joint_torque(self.v, self.a, self.direction)
        return own if self.found is None else own + self.found.lost

    @property
    def sensed(self) -> Array:
        """Torque that a sensor passes on, before its gain and offset [N·m], (K, n)."""
        return self.model if self.found is None else self.model + self.found.bent

    @property
    def read(self) -> "PreparedSignals":
        """The signals as they were read: positions without the corrections of an estimate."""
        return self if self.found is None else self.found.read

    @cached_property
    def gravity_columns(self) -> Array:
        """Model torque per unit of gravity along each base axis, (K, n, 3)."""
        return np.stack([self.arm.gravity_torque(self.q, axis) for axis in np.eye(3)], axis=-1)

    def link_regressor(self, link: int) -> Array:
        """Columns of the model torque in a link's inertial parameters, (K, n, 10)."""
        if self.read is not self and self._moves_as_read:
            return self.read.link_regressor(link)
        return self.arm.link_regressor(self._motion, link)

    @cached_property
    def _motion(self) -> LinkMotion:
        return self.arm.motion(self.q, self.v, self.a)

    def sensitivity(self, joint: int) -> tuple[Array, Array, Array]:
        """Derivatives of the model torque with respect to one joint's position, velocity, acceleration, (K, n) each."""
        read, own = self.read, self.arm
        if read is not self and self._moves_as_read and np.array_equal(read.arm.inertial, own.inertial):
            return read.sensitivity(joint)
        if joint not in self._sensitivities:
            self._sensitivities[joint] = torque_slopes(own, self._motion[0], self.q, self.v, self.a, joint)
        return self._sensitivities[joint]

    @property
    def _moves_as_read(self) -> bool:
        """Whether the estimate has the positions and the gravity that were there before it."""
        return self.read.q is self.q and np.array_equal(self.read.arm.gravity, self.arm.gravity)

    @cached_property
    def _sensitivities(self) -> dict[int, tuple[Array, Array, Array]]:
        return {}

    @cached_property
    def direction(self) -> Array:
        """Sign of the velocity, linear through zero within the creeping speed, (K, n)."""
        return np.clip(self.v / CREEP, -1.0, 1.0)

    @cached_property
    def moving(self) -> Array:
        """1 if a joint moves faster than the creeping speed, or than a simulation of the model creeps, (K, n)."""
        return (np.abs(self.v) > np.clip(SLIDES * self.arm.creep, CREEP, MOST_CREEP)).astype(float)

    def release(self) -> None:
        """Free what is large and can be computed again; of signals as they were read, not what is asked for again."""
        for name in ("_sensitivities", *(("_motion", "gravity_columns") if self.found is not None else ())):
            self.__dict__.pop(name, None)

    @property
    def step(self) -> int:
        """Decimation from the work rate to the rate of the comparison."""
        return max(1, round(self.rate / (4.0 * self.band)))

    def filtered(self, x: Array) -> Array:
        """Low-pass (4th-order Butterworth, forward and backward), trimmed and decimated; (K, …) → (k, …)."""
        return np.ascontiguousarray(self.sampled(self._low_pass(x)))

    @cached_property
    def _low_pass(self) -> Callable[[Array], Array]:
        return low_pass(self.band, self.rate, round(PAD_S * self.rate))

    def upper_half(self, x: Array) -> Array:
        """RMS within the pass band of white noise with the same RMS in its upper half as `filtered` values x (k, …),
        (…)."""
        rate = self.rate / self.step
        sections = butter(4, 0.5 * self.band, btype="high", fs=rate, output="sos")
        frequency = np.linspace(0.0, 0.5 * rate, 512)
        low = butter(4, self.band, fs=self.rate, output="sos")
        passed = np.abs(sosfreqz(low, frequency, fs=self.rate)[1]) ** 4
        upper = passed * np.abs(sosfreqz(sections, frequency, fs=rate)[1]) ** 4
        share = upper.sum() / passed.sum()
        return np.asarray(np.sqrt(np.mean(sosfiltfilt(sections, x, axis=0) ** 2, axis=0) / share))

    def sampled(self, x: Array) -> Array:
        """The rows of `x` at which `filtered` has its values, unfiltered."""
        trim = max(1, round(TRIM_S * self.rate))
        return x[trim : len(x) - trim : self.step]


@dataclass(frozen=True, eq=False)
class Found:
    """Torques that an estimate adds along a recording."""

    read: PreparedSignals
    """The signals before the estimate."""
    link: Array
    """Torque of the links and of springs across the joints [N·m], (K, n)."""
    lost: Array
    """Torque between link and motor beside the nominal model's: friction, rotors, ripple [N·m], (K, n)."""
    bent: Array
    """Torque that the sensor adds by hysteresis, crosstalk and the like, before gain and offset [N·m], (K, n)."""
    springs: Array | float = 0.0
    """Share of `link` that springs across the joints have [N·m], (K, n)."""


def require_length(recordings: Sequence[Recording], labels: Sequence[str], shortest: float = 0.0) -> None:
    """Raise BadInput if all recordings together are too short, or one is shorter than `shortest` [s]."""
    spans = [float(recording.t[-1] - recording.t[0]) if len(recording.t) else 0.0 for recording in recordings]
    for recording, label, span in zip(recordings, labels, spans, strict=False):
        if len(recording.t) < 4 or sum(spans) < SHORTEST_S or span < shortest:
            raise BadInput(
                f"{label}: {len(recording.t)} rows over {span:.3g} s are too short for a diagnosis: record "
                f"at least {SHORTEST_S:.0f} s, in one recording or in several"
            )


def prepare(
    recording: Recording,
    arm: RigidArm,
    label: str = "recording",
    number: int = 0,
    groups: tuple[str, ...] = (),
    start: float | None = None,
) -> PreparedSignals:
    """Prepare a recording for the comparison with `arm`. Raises BadInput if it cannot be used, with the reason.

    `start` is the time at which the recording that this is a part of began [s]; times count from there.
    """
    if recording.n != arm.n:
        raise BadInput(
            f"{label} has {recording.n} joints, but the model has {arm.n}: give the model of the recorded arm"
        )
    raw_step = float(np.median(np.diff(recording.t)))
    span = float(recording.t[-1] - recording.t[0])
    if span > MOST_SAMPLES_PER_ROW * raw_step * recording.t.size:
        raise BadInput(
            f"{label}: {recording.t.size} rows over {span:.3g} s are mostly {raw_step:.2g} s apart: did "
            "several rows get the same time stamp? Record the times of sampling"
        )
    even = np.arange(recording.t[0], recording.t[-1] + 0.5 * raw_step, raw_step)
    stride = max(1, int(1.0 / raw_step / WORK_HZ + 0.1))
    rate = 1.0 / (raw_step * stride)
    band = min(BAND_HZ, rate / 5.0)
    if band < 0.5:
        raise BadInput(f"{label}: {rate:.3g} rows a second are too few: record at 10 Hz or more")
    thin = decimation(1.0 / raw_step, stride)
    q = thin(interpolate_even(recording.t, recording.position, even, label, "q"))
    smooth = low_pass(min(SMOOTH_HZ, 0.4 * rate), rate)
    times = even[::stride]
    spline = make_interp_spline(times, smooth(q), k=5)
    q, v, a = (np.asarray(spline(times, order)) for order in range(3))
    if rate < SLOW_HZ and recording.velocity is not None and np.isfinite(recording.velocity).all():
        v = smooth(thin(interpolate_even(recording.t, recording.velocity, even, label, "dq")))
        a = np.asarray(make_interp_spline(times, v, k=5)(times, 1))
    reading, known, noise = {}, {}, {}
    channels = {channel: getattr(recording, name) for channel, name in CHANNELS.items()}
    spikes = {channel: spikes_of(recording.t, x) for channel, x in channels.items() if x is not None}
    for channel, spiked in spikes.items():
        values = np.where(spiked, np.nan, channels[channel])
        if not np.isfinite(values).any():
            continue
        reading[channel] = thin(interpolate_even(recording.t, values, even, label, channel))
        known[channel] = coverage(recording.t, values, even)[::stride]
        noise[channel] = np.array([band_noise(recording.t, values[:, j], band) for j in range(arm.n)])
    if not reading:
        raise BadInput(f"{label}: no torque channel has a number: at least one of tau, tau_motor and tau_cmd is needed")
    near = are_near_spikes(recording.t, list(spikes.values()), times)
    known = {channel: there * ~near for channel, there in known.items()}
    clock = times - (times[0] if start is None else start)
    temperature = _warmth(recording, times)
    signals = PreparedSignals(
        label, rate, band, clock, q, v, a, reading, known, noise, arm, temperature, number, groups
    )
    return _without_stuck(replace(signals, spikes=count_spikes(spikes, channels)), recording)


def _warmth(recording: Recording, times: Array) -> Array | None:
    """Temperatures at these times (K, n); None unless every joint has one."""
    read = recording.temperature
    if read is None or not np.isfinite(read).any(0).all():
        return None
    return at_times(times, recording.t, read)


def _without_stuck(s: PreparedSignals, recording: Recording) -> PreparedSignals:
    """The signals with stuck readings marked as not known."""
    known, found = dict(s.known), []
    for channel in s.reading:
        values = getattr(recording, CHANNELS[channel])
        for joint in range(s.n):
            there = np.isfinite(values[:, joint])
            held = s.moving[:, joint] == 0.0 if channel != "tau" else np.zeros(len(s.t), bool)
            own = recording.t[there] - recording.t[0] + s.t[0]
            still = stuck_intervals(s.t, s.model[:, joint], held, own, values[there, joint])
            if still:
                marked = known[channel].copy()
                for start, end in still:
                    marked[(s.t >= start) & (s.t <= end), joint] = 0.0
                known[channel] = marked
                found.append(Stuck(channel, joint, sum(end - start for start, end in still)))
    return replace(s, known=known, stuck=tuple(found))


SLOW_HZ = 60.0
"""Below this rate [Hz] the recorded velocity is used; above, the position is differentiated, for drives report velocity
late."""
STEP_RATIO = 3.5
"""Largest ratio of a step between readings to the median step for interpolation by splines."""


def interpolate_even(t: Array, values: Array, even: Array, label: str, column: str) -> Array:
    """Values on the even time base, by cubic splines for a channel that is slow and even, else linear.

    Raises BadInput if a whole column is missing.
    """
    out = np.empty((len(even), values.shape[1]))
    for j in range(values.shape[1]):
        there = np.isfinite(values[:, j])
        if there.sum() < 4 or (column == "q" and there.mean() < 0.2):
            raise BadInput(
                f"{label}: column {column}_{j + 1} holds only {int(there.sum())} numbers in {len(t)} rows: "
                "record a reading in most rows, or leave this channel out"
            )
        own = t[there]
        steps, usual = np.diff(own), float(np.median(np.diff(own)))
        even_enough = steps.max() < STEP_RATIO * usual and steps.min() > usual / STEP_RATIO and usual > 1.0 / SLOW_HZ
        curve = CubicSpline(own, values[there, j]) if even_enough else None
        inside = np.clip(even, own[0], own[-1])
        out[:, j] = np.interp(inside, own, values[there, j]) if curve is None else curve(inside)
    return out


def at_times(times: Array, t: Array, values: Array, known: Mask | None = None) -> Array:
    """Columns (K, n) of values at `t` at other times, along straight lines between those `known` (K, n), by default all
    that are finite; a column without any is 0."""
    known = np.isfinite(values) if known is None else known
    columns = zip(known.T, values.T, strict=True)
    return np.column_stack([np.interp(times, t[k], x[k]) if k.any() else np.zeros_like(times) for k, x in columns])


def coverage(t: Array, values: Array, even: Array) -> Array:
    """1 if a reading is within a few of the channel's own periods, (K, n)."""
    out = np.zeros((len(even), values.shape[1]))
    for j in range(values.shape[1]):
        there = t[np.isfinite(values[:, j])]
        after = np.clip(np.searchsorted(there, even), 1, len(there) - 1)
        gap = there[after] - there[after - 1]
        out[:, j] = gap <= max(6.0 * float(np.median(np.diff(there))), 0.05)
    return out


def decimation(rate: float, stride: int) -> Callable[[Array], Array]:
    """Decimation by `stride` of a signal at `rate` [Hz], after a low pass."""
    if stride == 1:
        return lambda x: x
    low = low_pass(0.4 * rate / stride, rate)
    return lambda x: low(x)[::stride]


def low_pass(cut: float, rate: float, pad: int = 15) -> Callable[[Array], Array]:
    """Zero-phase low pass (4th-order Butterworth) at `cut` of signals at `rate` [Hz], along the first axis.

    `pad` is the length of the reflection at either end, in samples.
    """
    return partial(_both_ways, butter(4, cut, fs=rate, output="sos"), pad)


def _both_ways(sections: Array, pad: int, x: Array) -> Array:
    return np.asarray(sosfiltfilt(sections, x, axis=0, padlen=min(pad, len(x) - 1)))
