"""Torque and position loops of the drives, for all joints at once.

The motor torque is `drive − stiffness·q − damping·q̇`, clamped to the max torque (6072h); the plant evaluates it at
every step of the physics. `drive` is the target torque in torque modes and
`stiffness·target + damping·target rate + integral + feed-forward` in position modes. The integrator is stopped within a
dead band and at the clamp, to avoid hunting under stiction and wind-up on a stop. Drives that are no CiA 402 drives
(`sim_bus.drives`) give stiffness, damping and drive torque of their joint themselves.
"""

import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.drives.canopen.units import USER_UNITS
from sim_bus.node.object_arrays import ObjectArrays
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import JointSensors
from sim_bus.sim_section import sim_section

UNIT = 2 * np.pi / USER_UNITS
OFF, TORQUE, POSITION, IMPEDANCE = 0, 1, 2, 3
PROFILE_POSITION, PROFILE_TORQUE, CSP, CSV, CST = 1, 4, 8, 9, 10
KINDS = {PROFILE_POSITION: POSITION, PROFILE_TORQUE: TORQUE, CSP: POSITION, CSV: POSITION, CST: TORQUE}
LATE_SHARE = 0.5
"""Stability limit with a motor delay: damping times delay is at most this share of the motor's inertia."""
INTEGRAL_SHARE = 0.3
"""Integral gain = this · stiffness · bandwidth."""
TUNING_POSES = 50
"""Number of poses; the loops are tuned for the largest inertia among them."""
EXTRAPOLATED = 1.0
"""A cyclic position target that is late is extrapolated for this many interpolation times, then held, as drives do (one
cycle is usual), so that a late SYNC is no jerk."""
LOCKING = 8.0
"""Interpolation times in which a cyclic position target falls into step with SYNC: drives lock their interpolation to
it, so that its jitter hardly changes the speed of the target."""
SPARE_ACCELERATION = 100.0
"""The loops are tuned for the bare arm's inertia plus rated torque divided by this acceleration [rad/s²]."""


class Loops:
    """Targets and integrators; arrays (n,)."""

    def __init__(self, arm: ArmFile, plant: Plant, sensors: JointSensors, signals: ObjectArrays) -> None:
        section, self.n = sim_section(arm).servo, plant.n
        self._plant, self._sensors = plant, sensors
        self.rated = arm.require_link().rated_torques
        self._per_mille = self.rated / 1000
        poses = np.random.default_rng(0).uniform(plant.lower, plant.upper, (TUNING_POSES, self.n))
        inertia = np.max([np.diag(plant.inertia(pose)) for pose in poses], axis=0) + self.rated / SPARE_ACCELERATION
        self._inertia, self._damping_ratio = inertia, section.damping
        self._deadband, self.deceleration = section.deadband, np.full(self.n, section.quick_stop_deceleration)
        self._bandwidth = section.bandwidth
        families = [joint.settings.family for joint in arm.require_link().joints]
        self._with_brake = np.array([section.brake and family == "canopen" for family in families])
        self.kind, self.mode = np.zeros(self.n, int), np.zeros(self.n, int)
        self.stopping = np.zeros(self.n, bool)
        self.limit = np.zeros(self.n)
        """Active torque limit [N·m]."""
        self._torque, self._target, self._rate = np.zeros(self.n), plant.motor_position, np.zeros(self.n)
        self._integral = np.zeros(self.n)
        self._given = np.zeros((3, self.n))
        """Stiffness, damping and limit of joints whose drive gives them; 0 for the others."""
        self._given_anew = False
        self.imagined = np.zeros(self.n)
        """Offset of a drive's current sensor, as torque [N·m]: so much less is made than the drive asks for."""
        self._fresh: dict[int, NDArray[np.bool_]] = {
            index: np.zeros(self.n, bool) for index in (0x6071, 0x607A, 0x60FF)
        }
        self._torque_in, self._position_in, self._velocity_in = (signals[index, 0] for index in self._fresh)
        self._feed_forward_in, self._profile_velocity = signals[0x60B2, 0], signals[0x6081, 0]
        self._profile_acceleration, self._torque_slope = signals[0x6083, 0], signals[0x6087, 0]
        self._max_torque_in = signals[0x6072, 0]
        self.interpolation, self._longest = np.zeros(self.n), 0.0
        """Interpolation time of cyclic position targets (60C2h) [s], and the longest one."""
        self._locking = np.ones(self.n)
        """Share of what a target is ahead or behind that is caught up in an interpolation time."""
        self._aim, self._since = self._target.copy(), 0.0
        """Position target of the last SYNC [rad], and the time since then [s]."""
        self._left = np.zeros(self.n)
        """Time for which position targets go on at their rates without another SYNC [s]."""
        self.lowest, self.highest = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        """Software position limits (607Dh) in user units."""
        self.reconfigure()

    def interpolate(self, joint: int, seconds: float) -> None:
        """Set the interpolation time of a joint [s]; 0: targets are reached in the step after SYNC."""
        self.interpolation[joint] = seconds
        self._longest = float(self.interpolation.max())
        self._locking[joint] = 1.0 / LOCKING if seconds > 0.0 else 1.0

    def fresh(self, index: int, rows: list[int]) -> None:
        """Mark targets in object `index` as received for the joints `rows`."""
        waiting = self._fresh[index]
        if np.count_nonzero(waiting) < self.n and not waiting[rows].all():
            waiting[rows] = True
            self._select()

    def start(self, joint: int, kind: int, mode: int) -> None:
        """Switch a joint's loop without a bump, from its present torque and position."""
        plant = self._plant
        powered = self.kind[joint] != OFF or not self._with_brake[joint]
        torque = float((plant.drive_torque if powered else plant.link_torque)[joint])
        velocity = float(plant.motor_velocity[joint])
        self._torque[joint] = torque if kind == TORQUE else 0.0
        self._target[joint], self._rate[joint] = plant.motor_position[joint], 0.0
        self._aim[joint] = self._target[joint]
        self.kind[joint], self.mode[joint], self.stopping[joint] = kind, mode, False
        for waiting in self._fresh.values():
            waiting[joint] = False
        self.reconfigure()
        self._integral[joint] = torque + self._d[joint] * velocity if kind == POSITION else 0.0

    def impede(self, joint: int, stiffness: float, damping: float, drive: float, limit: float) -> None:
        """Motor torque `drive − stiffness·q − damping·q̇` within ±limit, from the next step on (true motor angle)."""
        if self.kind[joint] != IMPEDANCE:
            self.start(joint, IMPEDANCE, 0)
        self._torque[joint] = drive - self.imagined[joint]
        self._given[:, joint] = stiffness, damping, limit
        self._given_anew = True

    def tuned(self, joint: int) -> tuple[float, float, float]:
        """Stiffness, damping and integral gain of the position loop that suits a joint, in SI units."""
        bandwidth, inertia = float(self._stable_bandwidth()[joint]), float(self._inertia[joint])
        stiffness = inertia * bandwidth**2
        return stiffness, 2 * self._damping_ratio * inertia * bandwidth, INTEGRAL_SHARE * bandwidth * stiffness

    def release(self, joint: int) -> None:
        """Take the power from a joint under impede()."""
        self._given[:, joint] = 0.0
        self.start(joint, OFF, 0)

    def stop(self, joint: int) -> None:
        """Decelerate a joint to rest (quick stop deceleration) and hold it there."""
        velocity = self._plant.motor_velocity[joint]
        self.start(joint, POSITION, int(self.mode[joint]))
        self._rate[joint] = velocity
        self._integral[joint] -= self._d[joint] * velocity
        self.stopping[joint] = True
        self._select()

    def stopped(self, joint: int) -> bool:
        return bool(self.stopping[joint] and self._rate[joint] == 0.0)

    @property
    def following_error(self) -> Array:
        """Following error of position-controlled joints [rad]; 0 for the others."""
        return np.where(self.kind == POSITION, self._target - self._plant.motor_position, 0.0)

    def reconfigure(self) -> None:
        """Apply modes and limits to the plant."""
        self.limit = np.where(self.kind == IMPEDANCE, self._given[2], self._max_torque_in * self._per_mille)
        closed, bandwidth = self.kind == POSITION, self._stable_bandwidth()
        self._closed = closed.astype(float)
        self._k = self._inertia * bandwidth**2 * self._closed
        self._d = 2 * self._damping_ratio * self._inertia * bandwidth * self._closed
        self._ki = INTEGRAL_SHARE * bandwidth * self._k
        self._powered = self.kind != OFF
        self._fed_forward = self._per_mille * self._powered
        self._serve()
        if self._with_brake.any():
            self._plant.set_brakes(self._with_brake & ~self._powered)
        self._select()

    def _serve(self) -> None:
        stiffness, damping, limit = self._given
        np.copyto(self.limit, limit, where=self.kind == IMPEDANCE)
        limits = np.where(self._powered, self.limit, 0.0)
        self._plant.set_servo(self._k + stiffness, self._d + damping, limits)
        self._given_anew = False

    def _stable_bandwidth(self) -> Array:
        """The configured bandwidth, reduced as far as a motor's delay requires."""
        turned = np.minimum(self._inertia, self._plant.rotor_inertia)
        damped = 2 * self._damping_ratio * self._inertia
        most = LATE_SHARE * turned / (damped * np.maximum(self._plant.lateness, 1e-9))
        return np.asarray(np.minimum(most, self._bandwidth))

    def _select(self) -> None:
        """Update which joints follow which target."""
        torque, position, velocity = self._fresh.values()
        free = ~self.stopping
        self._cyclic_torque = (self.mode == CST) & (self.kind == TORQUE) & torque
        self._profile_torque = (self.mode == PROFILE_TORQUE) & (self.kind == TORQUE) & torque
        self._cyclic_position = (self.mode == CSP) & (self.kind == POSITION) & position & free
        self._profile_position = (self.mode == PROFILE_POSITION) & (self.kind == POSITION) & position & free
        self._cyclic_velocity = (self.mode == CSV) & (self.kind == POSITION) & velocity & free
        self._any_closed = bool(self._closed.any())
        self._any_stopping = bool(self.stopping.any())
        self._any_position = bool(self._cyclic_position.any())
        self._any_slow = bool((self._profile_torque | self._profile_position | self._cyclic_velocity).any())

    def advance(self, duration: float, synchronous: bool) -> None:
        """Run loops and plant for `duration` [s]; `synchronous`: directly after a SYNC with its new targets."""
        if self._given_anew:
            self._serve()
        np.copyto(self._torque, self._torque_in * self._per_mille, where=self._cyclic_torque)
        if self._any_slow:
            self._follow_profiles(duration)
        level = self._torque + self._feed_forward_in * self._fed_forward
        if not self._any_closed:
            self._plant.step(level, level, duration)
            return
        self._plan(duration, synchronous)
        error = (self._target - self._plant.motor_position) * self._closed
        error *= np.abs(error) > self._deadband
        self._integral += self._ki * error * duration
        np.minimum(np.maximum(self._integral, -self.limit, out=self._integral), self.limit, out=self._integral)
        level += self._k * self._target + self._d * self._rate + self._integral
        if np.count_nonzero(self._rate):
            move = self._rate * duration
            self._plant.step(level, level + self._k * move, duration)
            self._target += move
        else:
            self._plant.step(level, level, duration)

    def _plan(self, duration: float, synchronous: bool) -> None:
        """Set the rates of the position targets for the next `duration` [s]."""
        if self._any_position:
            if synchronous:
                wanted = np.minimum(np.maximum(self._position_in, self.lowest), self.highest)
                self._approach(self._sensors.angle_of(wanted * UNIT), duration)
            else:
                share = np.minimum(np.maximum(self._left, 0.0) / duration, 1.0)
                np.copyto(self._rate, self._rate * share, where=self._cyclic_position)
                self._left -= duration
            self._since += duration
        if self._any_stopping:
            slower = np.maximum(np.abs(self._rate) - self.deceleration * duration, 0.0) * np.sign(self._rate)
            np.copyto(self._rate, slower, where=self.stopping)

    def _approach(self, aim: Array, duration: float) -> None:
        """Set the rates that bring the cyclic position targets to `aim` [rad] an interpolation time after this SYNC.

        The speed is that of the aims from SYNC to SYNC; what the target is ahead of it or behind is caught up slowly.
        """
        time, way = np.maximum(self.interpolation, duration), aim - self._aim
        cycles = round(self._since / max(self._longest, duration))
        if cycles > 1:
            way /= cycles
        behind = aim - way - self._target
        np.copyto(self._rate, (way + behind * self._locking) / time, where=self._cyclic_position)
        np.copyto(self._aim, aim, where=self._cyclic_position)
        np.subtract(time + EXTRAPOLATED * self.interpolation, duration, out=self._left)
        self._since = 0.0

    def _follow_profiles(self, duration: float) -> None:
        """Follow profile torque (slope 6087h), profile position (6081h, 6083h) and cyclic velocity (60FFh)."""
        step = self._torque_slope * (self._per_mille * duration)
        wanted = self._torque_in * self._per_mille
        ramped = self._torque + np.clip(wanted - self._torque, -step, step)
        np.copyto(self._torque, ramped, where=self._profile_torque)
        gain = self._sensors.position_gain
        np.copyto(self._rate, self._velocity_in * (UNIT * gain), where=self._cyclic_velocity)
        target = np.minimum(np.maximum(self._position_in, self.lowest), self.highest)
        way = self._sensors.angle_of(target * UNIT) - self._target
        acceleration = self._profile_acceleration * UNIT
        speed = np.minimum(np.abs(self._rate) + acceleration * duration, self._profile_velocity * UNIT)
        speed = np.minimum(speed, np.sqrt(2 * acceleration * np.abs(way)))
        speed = np.minimum(speed, np.abs(way) / duration)
        np.copyto(self._rate, np.sign(way) * speed, where=self._profile_position)
