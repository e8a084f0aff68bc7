"""The reading of a joint, slow or at rest, whose torque is a current, and its derivatives (docs/theory.md, section 11).

    v = g (1 + w·warmth) (τ + (s + a)(F_c + μ|τ|) + s·u(q) + F_v q̇ + c(q) + κ (q − q̄)) + o

τ is the gravity torque of joint i at the angles q + zero − lag·q̇, with the reference mass where it hangs: torque is
read a little later than the position; s is the direction, at rest that of the last motion. c is a line of ripple, of a
given period; κ a spring's stiffness, which is 0 unless one is looked for. The product a·u is left out: a
millinewton-metre or so, it would be all that tells a from the offset where torque keeps its sign, and no arm is as
exact as that.
"""

from dataclasses import dataclass, replace

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.identify.parameters import Parameters, Prior
from gcomp.identify.parameters import family_slices as sensor_slices
from gcomp.identify.readings import StaticReadings
from gcomp.identify.sensor_model import predict, predict_and_jacobian

HARMONICS = 2
"""Friction over position: cosine and sine of so many multiples of the joint angle."""
LAST_ZERO = 1e-6
"""The last joint's zero is kept at 0 [rad]: turning the last link's frame is the same as turning its mass moment and
the place of the mass (docs/theory.md, 4.1). A measured place resolves it."""
FAMILIES = (
    "gain", "offset", "coulomb", "load", "viscous", "asymmetry", "warming", "zero", "lag", "spring", "uneven",
    "ripple", "beta", "rho",
)  # fmt: skip
"""In the order of the vector."""


def family_slices(n: int) -> dict[str, slice]:
    """Place of each family in the vector of an arm of n joints."""
    sizes = {"lag": 1, "uneven": 2 * HARMONICS * n, "ripple": 2 * n, "beta": 2 * n, "rho": 3}
    slices, begin = {}, 0
    for family in FAMILIES:
        slices[family] = slice(begin, begin + sizes.get(family, n))
        begin = slices[family].stop
    return slices


@dataclass(frozen=True)
class MotorDoubt:
    """Standard deviations beforehand, one for all joints; each a choice that real arms stay well within."""

    gain: float = 0.5
    """About 1: makers' torque constants were found wrong by up to 1.5."""
    offset_share: float = 0.1
    """Of rated torque."""
    coulomb_share: float = 0.15
    """Of rated torque."""
    load: float = 0.07
    """Friction per torque: a planetary gear of 0.9 efficiency has 0.1."""
    viscous_share: float = 0.02
    """Of rated torque, per rad/s, about `viscous_mean`."""
    viscous_mean: float = 0.015
    """Of rated torque, per rad/s: 0.1 to 0.5 N·m·s/rad were measured on drives of 3 to 20 N·m."""
    asymmetry: float = 0.07
    """Friction of the two directions, half difference over mean."""
    warming: float = 0.001
    """Per kelvin, about `warming_mean`."""
    warming_mean: float = 0.001
    """Magnets lose a tenth of a per cent per kelvin: the drive then takes the same current for more torque than it
    makes."""
    warming_by_time: float = 0.02
    """Over all passes, where no temperature is known."""
    zero: float = 0.03
    """Position zero that was set by hand [rad]."""
    lag: float = 0.005
    """How much later than the position the torque is read, one for all joints: drives filter it, or average it [s]."""
    uneven: float = 0.15
    """Friction over position, as a share of the joint's Coulomb friction."""
    ripple: float = 0.3
    """Ripple of torque over position, as a share of the joint's Coulomb friction."""
    rho: float = 0.3
    """Place of the mass [m]."""
    spring_share: float = 1e-5
    """Pull that grows with position, of rated torque per rad: none, unless it is looked for."""
    point: Prior | None = None
    """Place of the mass, where it was measured [m]; the last joint's zero is then seen by it."""

    def prior(
        self, arm: Arm, rated: Array, by_temperature: bool, coulomb: Array, uneven: Array | None = None
    ) -> tuple[Array, Array]:
        """(Mean, standard deviation) of the vector.

        `coulomb` (n,) > 0 scales the friction over position [N·m], of which `uneven` (HARMONICS,) are the harmonics'
        shares.
        """
        n, slices = arm.n, family_slices(arm.n)
        mean, std = np.zeros(slices["rho"].stop), np.empty(slices["rho"].stop)
        mean[slices["gain"]] = 1.0
        mean[slices["viscous"]] = self.viscous_mean * rated
        if by_temperature:
            mean[slices["warming"]] = self.warming_mean
        gravity = float(np.linalg.norm(arm.gravity))
        shares = np.full(HARMONICS, self.uneven) if uneven is None else uneven
        values = {
            "gain": self.gain,
            "offset": self.offset_share * rated,
            "coulomb": self.coulomb_share * rated,
            "load": self.load,
            "viscous": self.viscous_share * rated,
            "asymmetry": self.asymmetry,
            "warming": self.warming if by_temperature else self.warming_by_time,
            "zero": self.zero,
            "lag": self.lag,
            "spring": self.spring_share * rated,
            "uneven": np.outer(coulomb, np.repeat(shares, 2)).ravel(),
            "ripple": np.repeat(self.ripple * coulomb, 2),
            "beta": np.repeat(3.0 * float(rated.max()) / gravity, 2 * n),
            "rho": self.rho,
        }
        for family, value in values.items():
            std[slices[family]] = value
        if self.point is None:
            std[slices["zero"].stop - 1] = LAST_ZERO
        else:
            mean[slices["rho"]], std[slices["rho"]] = self.point.mean, self.point.std
        return mean, std


class MotorModel:
    """The R readings that count, row by row and joint by joint, for given parameters."""

    def __init__(self, arm: Arm, readings: StaticReadings, ripple: Array | None = None) -> None:
        """`ripple` (n,) are the periods in a turn of each joint's ripple, 0 where there is none."""
        self.arm, self.readings, self.n = arm, readings, arm.n
        self.slices = family_slices(arm.n)
        self.size = self.slices["rho"].stop
        self._each, self.joint = np.nonzero(readings.counted)
        self.reading = readings.torque[self._each, self.joint]
        self.velocity = readings.velocity[self._each, self.joint]
        last = readings.direction[self._each, self.joint]
        self._side = np.where(last == 0, np.sign(self.velocity), last)
        self._warmth = readings.warmth[self._each, self.joint]
        own = readings.position[self._each, self.joint]
        self._waves = np.stack([f(k * own) for k in range(1, HARMONICS + 1) for f in (np.cos, np.sin)], axis=1)
        self.ripple = np.zeros(self.n) if ripple is None else ripple
        cycles = self.ripple[self.joint]
        self._ripple = np.stack([np.cos(cycles * own), np.sin(cycles * own)], axis=1) * (cycles > 0)[:, None]
        count = np.bincount(self.joint, minlength=self.n)
        means = np.bincount(self.joint, own, minlength=self.n) / np.maximum(count, 1)
        self._stretch = own - means[self.joint]

    def _gravity(self, x: Array) -> tuple[Parameters, StaticReadings]:
        """Parameters and readings of which the sensor model gives the gravity torque of each row's joint."""
        of = {family: x[self.slices[family]] for family in ("beta", "rho")}
        moved = self.readings.position - x[self.slices["lag"]] * self.readings.velocity
        found = Parameters.nominal(self.n, position_offset=x[self.slices["zero"]], **of)
        return found, replace(self.readings, position=moved)

    def predict(self, x: Array) -> Array:
        """Readings (R,) [N·m] for the parameter vector x."""
        torque = predict(self.arm, *self._gravity(x))[self._each, self.joint]
        gain, scale, motor = self._motor(x, torque)
        return np.asarray(gain * scale * motor + x[self.slices["offset"]][self.joint])

    def _motor(self, x: Array, torque: Array) -> tuple[Array, Array, Array]:
        """(Gain, factor of warming, torque at the motor [N·m]) of each row (R,)."""
        of = {
            family: x[place][self.joint] for family, place in self.slices.items() if place.stop - place.start == self.n
        }
        side = self._side
        motor = torque + (side + of["asymmetry"]) * (of["coulomb"] + of["load"] * np.abs(torque))
        motor += side * (self._waves * x[self.slices["uneven"]].reshape(self.n, -1)[self.joint]).sum(axis=1)
        motor += (self._ripple * x[self.slices["ripple"]].reshape(self.n, 2)[self.joint]).sum(axis=1)
        motor += of["viscous"] * self.velocity + of["spring"] * self._stretch
        return of["gain"], 1 + of["warming"] * self._warmth, motor

    def linearised(self, x: Array) -> tuple[Array, Array]:
        """(Readings (R,), derivatives (R, P))."""
        at, j, each, side = self.slices, self.joint, np.arange(len(self.joint)), self._side
        torque, by_sensor, _ = predict_and_jacobian(self.arm, *self._gravity(x))
        gain, scale, motor = self._motor(x, torque)
        coulomb, load, asymmetry = (x[at[name]][j] for name in ("coulomb", "load", "asymmetry"))
        both, slope = side + asymmetry, gain * scale
        jacobian = np.zeros((len(j), self.size))
        own = {
            "gain": scale * motor,
            "offset": np.ones(len(j)),
            "coulomb": slope * both,
            "load": slope * both * np.abs(torque),
            "viscous": slope * self.velocity,
            "asymmetry": slope * (coulomb + load * np.abs(torque)),
            "warming": gain * self._warmth * motor,
            "spring": slope * self._stretch,
        }
        for family, column in own.items():
            jacobian[each, at[family].start + j] = column
        for family, columns in (("uneven", side[:, None] * self._waves), ("ripple", self._ripple)):
            for k, column in enumerate(columns.T):
                jacobian[each, at[family].start + columns.shape[1] * j + k] = slope * column
        by_torque = (slope * (1 + both * load * np.sign(torque)))[:, None]
        sensor = sensor_slices(self.n)
        for family, name in (("beta", "beta"), ("rho", "rho"), ("zero", "position_offset")):
            jacobian[:, at[family]] = by_torque * by_sensor[:, sensor[name]]
        jacobian[:, at["lag"].start] = -(jacobian[:, at["zero"]] * self.readings.velocity[self._each]).sum(axis=1)
        return slope * motor + x[at["offset"]][j], jacobian
