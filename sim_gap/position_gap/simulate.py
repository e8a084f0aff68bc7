"""Simulation of position-controlled joints: all windows, joints and hypotheses at once.

Velocities stand half a step before positions (leapfrog), and damping acts on the mean of two of them, so that the error
is of second order in the step: one of first order would show as a command that comes half a step early and a heavier
joint. Friction, damping too strong for the step and a position gain too high for it are implicit, so that it is stable
for any gains, and a joint sticks where friction exceeds what drives it, or creeps, if it may.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from gcomp.arrays import Array
from sim_gap.position_gap.columns import payload_inertia
from sim_gap.position_gap.windows import Windows

EXPLICIT = 0.5
"""Square of frequency times step up to which the position gain is taken at the step's start, without the damping that
an implicit step adds."""
MOST_CELLS = 6_000
"""Most joints times windows times hypotheses that are simulated together, for the cache's sake."""
MOST_CELL_STEPS = 40_000
"""Most cells times steps for which the quantities that do not depend on the motion are made at once, likewise."""
TURN = 1.5
"""Largest deviation from the recorded angle for which gravity's torque is continued [rad]."""
LIGHTEST = 0.01
"""Least share of a joint's inertia that damping of another simulation leaves."""
Values = Mapping[str, Array]
"""Parameter → (P, J); the names are those of `parameters` and of `Windows.columns`, and `kv`: as much of `viscous` as
the servo makes within its limit while it is on. `early` and `servo_late` are about a recording that another simulation
made: the half step by which its torques act early, and the times by which damping by its servos and friction under
which a joint creeps are late [s]."""


def simulate(data: Windows, values: Values) -> Array:
    """Positions at the times of comparison for P hypotheses [rad], (P, To, J, W).

    `values` have shapes (P, J); a parameter that is absent has its neutral value.
    """
    count = max(len(x) for x in values.values())
    size = max(1, MOST_CELLS // (data.joints * data.count))
    parts = []
    for first in range(0, count, size):
        some = {name: x[first : first + size] if len(x) > 1 else x for name, x in values.items()}
        parts.append(_run(_Joints(data, some, min(size, count - first))))
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


class _Joints:
    """Hypotheses and windows in the form in which they are stepped, (P, J, 1) for parameters."""

    def __init__(self, data: Windows, values: Values, count: int) -> None:
        self.data, self.count = data, count
        self.shape = (count, data.joints, data.count)
        self.given = {
            name: np.ascontiguousarray(np.broadcast_to(x[:, :, None], self.shape)) for name, x in values.items()
        }
        self.active = {name for name, x in self.given.items() if np.any(x != 0.0)}
        scaled = bool(np.any(data.scale != 1.0))
        self.kp, self.kd, self.ki = (self.of(n) * data.scale if scaled else self.of(n) for n in ("kp", "kd", "ki"))
        self.brake = np.minimum(self.of("kv"), self.of("viscous"))
        self.delay = self.of("delay") - self.of("early")
        self.solved = self.of("early") * self.of("viscous") - self.of("servo_late") * self.brake
        dt, gain = data.dt, self.of("gain", 1.0)
        stiff, self.damped = dt * dt * self.kp * gain, dt * self.kd * gain
        share = stiff / (data.inertia.mean(0) + self.of("armature")) - EXPLICIT
        self.stiff = stiff * np.clip(share, 0.0, 1.0)
        self.payload: dict[str, Array] = {}
        if "payload.mass" in self.active:
            x, y, z = (self.of(f"payload.{axis}") for axis in "xyz")
            self.payload = payload_inertia(self.of("payload.mass"), (x, y, z), data.arm)
        self.geared = bool(np.any(gain != 1.0)) or bool(np.any(data.served != 1.0))

    def of(self, name: str, neutral: float = 0.0) -> Array:
        """A parameter, (P, J, 1)."""
        return self.given[name] if name in self.given else np.full(self.shape, neutral)

    def steps(self, first: int, last: int) -> Iterator[tuple[Array, ...]]:
        """Terms that do not depend on the motion, for each of some steps, (P, J, W) or such that they broadcast.

        The command; the controller's torque beside that of error, its integral and velocity; the torque per torque of
        the controller; of the links' torque and all else that is constant, the part at the recorded angle and the
        factors of three powers of the deviation from it; and what `inertias` and `grip` give within the limit.
        """
        data, part = self.data, slice(first, last)
        command, push = self._late(data.command, part), np.zeros((1, 1, 1, 1))
        if "kd" in self.active:
            push = push + self.kd * self._late(data.speed, part)
        if "feed" in self.active:
            push = push + self.of("feed") * self._late(data.feed, part)
        gravity, slope, on = data.gravity[part], data.slope[part], data.served[part, None]
        rest = -(gravity + data.coupling[part])[:, None] - self.of("offset")
        for name in data.columns:
            if name in self.active:
                rest = rest - self.of(name) * data.columns[name][part, None]
        for name in self.payload.keys() & data.columns.keys():
            rest = rest - self.payload[name] * data.columns[name][part, None]
        carried, effective = self.inertias(data.inertia[part, None], on, on)
        grip = self.grip(data.load[part, None], effective)
        every = (command, push, self.of("gain", 1.0) * on, rest, carried, effective, grip)
        whole = (np.broadcast_to(x, (last - first, *self.shape)) for x in every)
        return zip(*whole, -slope, 0.5 * gravity, slope / 6.0, strict=True)

    def _late(self, signal: Array, part: slice) -> Array:
        """A signal of the command as it arrives, (B, P, J, W)."""
        if not self.active & {"delay", "early"}:
            return signal[part, None]
        late = self.delay[:, :, 0] / self.data.dt
        whole = np.floor(late).astype(int)
        joints, at = np.arange(self.data.joints), np.arange(part.start, part.stop)[:, None, None] - whole
        after, before = (np.clip(k, 0, len(signal) - 1) for k in (at, at - 1))
        share = (late - whole)[..., None]
        return np.asarray(signal[after, joints] * (1.0 - share) + signal[before, joints] * share)

    def inertias(self, own: Array, on: Array, free: Array) -> tuple[Array, Array]:
        """Inertia by which the velocity before counts, and that which the torque moves [kg·m²], from the links' own.

        1 where the servo is `on`, and `free` of its limit.
        """
        mass, outside = own + self.of("armature"), self.of("viscous") - self.brake * (1.0 - free)
        if "early" in self.active:
            mass = np.maximum(mass + self.solved, LIGHTEST * mass)
        lost = self.data.dt * (outside + self.of("back_emf") * on) + free * self.damped
        carried = mass - np.minimum(0.5 * lost, mass)
        return carried, carried + lost + free * self.stiff

    def grip(self, load: Array, effective: Array, v: Array | None = None, before: Array | None = None) -> Array:
        """Change of the velocity in a step up to which friction holds [rad/s]; without a velocity as if at any.

        Its level is that at the velocity `before` the step, its direction that of the velocity `v` without it: what
        rests is held by all of its breakaway friction.
        """
        hold = self.of("coulomb")
        if "load" in self.active:
            hold = hold + self.of("load") * load
        if before is not None and "stribeck" in self.active:
            hold = hold + self.of("stribeck") * np.exp(-((before / self.of("stribeck_velocity", 0.1)) ** 2))
        if v is not None and "asymmetry" in self.active:
            hold = hold * (1.0 + self.of("asymmetry") * np.sign(v))
        return np.asarray(hold * self.data.dt / effective)

    def integral(self) -> Array:
        """Integral of the error at the start of each window: what holds the arm at first, and the error since then."""
        data, ki = self.data, self.ki
        begun = np.where(self.of("feed") > 0.5, data.first_torque[1], data.first_torque[0])
        held = (begun / self.of("gain", 1.0) - self.kp * data.first_error) / np.maximum(ki, 1e-9) * (ki > 0.0)
        return np.asarray(data.error_sum - self.delay * data.travel + held)


def _run(joints: _Joints) -> Array:
    data, active, of = joints.data, joints.active, joints.of
    dt, steps, kp, ki, dead = data.dt, len(data.command), joints.kp, joints.ki, of("dead")
    limit, most = of("limit", np.inf), of("slew", np.inf) * dt
    clipped, slewed = bool(np.isfinite(limit).any()), bool(np.isfinite(most).any())
    braking, moving = joints.kd + joints.brake, bool(active & {"stribeck", "asymmetry"})
    creeps, creep = "creep" in active, np.maximum(of("creep"), 1e-9)
    lag = of("creep_lag") / dt * (of("creep") > 0.0)
    turn, step = (np.full(joints.shape, x) for x in (TURN, dt))  # numpy is slower with numbers
    q, v, target = (np.broadcast_to(x, joints.shape).copy() for x in (*data.start, data.command[0]))
    total = joints.integral() if "ki" in active else np.zeros(1)
    out = np.empty((joints.count, len(data.measured), data.joints, data.count))
    block = max(1, MOST_CELL_STEPS // q.size)
    ahead = (each for k in range(0, steps, block) for each in joints.steps(k, min(k + block, steps)))
    for k, (command, push, power, rest, carried, effective, grip, first, second, third) in enumerate(ahead):
        if k >= data.warm and (k - data.warm) % data.stride == 0:
            out[:, (k - data.warm) // data.stride] = q
        if slewed:
            target += _within(command - target, most)
            command = target
        error = command - q
        if "dead" in active:
            error -= _within(error, dead)
        torque = kp * error
        torque += push
        if "ki" in active:
            error *= 0.5 * dt * data.served[k]
            total = total + error
            torque += ki * total
            total += error
        held = False
        if clipped:
            wish = torque - braking * v
            over = np.abs(wish) > limit
            if held := bool(np.count_nonzero(over)):
                torque = np.where(over, _within(wish, limit), torque)
                carried, effective = joints.inertias(data.inertia[k], data.served[k], data.served[k] * ~over)
        if joints.geared:
            torque *= power
        x = _within(q - data.recorded[k], turn)
        bent = third * x
        for factor in (second, first):
            bent += factor
            bent *= x
        torque += bent
        torque += rest
        if "spring" in active:
            torque -= of("spring") * q
        before = v.copy() if moving or creeps else None
        v *= carried
        torque *= step
        v += torque
        v /= effective
        if held or moving:
            grip = joints.grip(data.load[k], effective, v, before)
        stopped = v
        if before is not None and creeps:
            share = grip / creep
            stopped = share * (v + lag * (v - before)) / (1.0 + share * (1.0 + lag))
        v -= _within(stopped, grip)
        q += step * v
    return out


def _within(x: Array, limit: Array) -> Array:
    """x clipped to ± limit; on arrays as small as these several times as fast as `np.clip`."""
    return np.asarray(np.minimum(np.maximum(x, -limit), limit))
