"""Simulation of position-controlled joints: all windows, joints and hypotheses at once.

Velocities stand half a step before positions (leapfrog), and damping acts on the mean of two of them, so that the error
is of second order in the step: one of first order would show as a command that comes half a step early and a heavier
joint. Friction, damping too strong for the step and a position gain too high for it are implicit, so that it is stable
for any gains, and a joint sticks where friction exceeds what drives it.
"""

from collections.abc import Mapping

import numpy as np

from gcomp.arrays import Array
from sim_gap.closed_loop.windows import Windows

EXPLICIT = 0.5
"""Square of frequency times step up to which the position gain is taken at the step's start, without the damping that
an implicit step adds."""
CELLS = 6_000
"""Most joints times windows times hypotheses that are simulated together, for the cache's sake."""
Values = Mapping[str, Array]
"""Parameter → (P, J); the names are those of `parameters` and of `Windows.columns`, and `kv`: as much of `viscous` as
the servo makes within its limit while it is on."""


def simulate(data: Windows, values: Values) -> Array:
    """Positions at the times of comparison for P hypotheses [rad], (P, To, J, W).

    `values` have shapes (P, J); a parameter that is absent has its neutral value.
    """
    count = max(len(x) for x in values.values())
    size = max(1, CELLS // (data.joints * data.count))
    parts = []
    for first in range(0, count, size):
        some = {name: x[first : first + size] if len(x) > 1 else x for name, x in values.items()}
        parts.append(_run(data, some, min(size, count - first)))
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _run(data: Windows, values: Values, count: int) -> Array:
    shape = (count, data.joints, data.count)
    dt, steps = data.dt, len(data.command)
    given = {
        name: np.ascontiguousarray(np.broadcast_to(x[:, :, None], (count, data.joints, 1)))
        for name, x in values.items()
    }
    active = {name for name, x in given.items() if np.any(x != 0.0)}

    def of(name: str, neutral: float = 0.0) -> Array:
        return given[name] if name in given else np.full((1, 1, 1), neutral)

    kp, kd, ki = (of(name) * data.scale if np.any(data.scale != 1.0) else of(name) for name in ("kp", "kd", "ki"))
    armature, viscous, gain = of("armature"), of("viscous"), of("gain", 1.0)
    back_emf, brake = of("back_emf"), np.minimum(of("kv"), of("viscous"))
    coulomb, asymmetry = of("coulomb"), of("asymmetry")
    limit, slew, dead = of("limit", np.inf), of("slew", np.inf), of("dead")
    most = slew * dt
    clipped, slewed = bool(np.isfinite(limit).any()), bool(np.isfinite(slew).any())
    braked = "kv" in active
    linear = [name for name in data.columns if name in active]
    late = of("delay") / dt
    whole = np.floor(late).astype(int)
    part = late - whole
    joints = np.arange(data.joints)[None, :]
    back = whole[:, :, 0]
    delayed, late_too = "delay" in active, (True, "kd" in active, "feed" in active)
    q = np.broadcast_to(data.start[0], shape).copy()
    v = np.broadcast_to(data.start[1], shape).copy()
    total = np.zeros(shape)
    if "ki" in active:
        total += _integral(data, of("feed"), of("delay"), kp, ki, gain)
    target = np.broadcast_to(data.command[0], shape).copy()
    out = np.empty((count, len(data.measured), data.joints, data.count))
    kept, stiff, damped = 0, dt * dt * kp * gain, dt * kd * gain
    stiff = stiff * np.clip(stiff / (data.inertia.mean(0) + armature) - EXPLICIT, 0.0, 1.0)
    for k in range(steps):
        if k >= data.warm and (k - data.warm) % data.stride == 0:
            out[:, kept] = q
            kept += 1
        command, speed, feed = data.command[k], data.speed[k], data.feed[k]
        if delayed:
            at, before = np.clip(k - back, 0, steps - 1), np.clip(k - back - 1, 0, steps - 1)
            command, speed, feed = (
                x[at, joints] * (1.0 - part) + x[before, joints] * part if needed else x[k]
                for x, needed in zip((data.command, data.speed, data.feed), late_too, strict=True)
            )
        if slewed:
            target += _within(command - target, most)
            command = target
        error = command - q
        on = data.served[k]
        if "dead" in active:
            error = error - _within(error, dead)
        torque = kp * error
        if "kd" in active:
            torque = torque + kd * speed
        if "ki" in active:
            total += 0.5 * dt * error * on
            torque = torque + ki * total
            total += 0.5 * dt * error * on
        if "feed" in active:
            torque = torque + of("feed") * feed
        free = on
        if clipped:
            wish = torque - (kd + brake) * v
            over = np.abs(wish) > limit
            torque = np.where(over, _within(wish, limit), torque)
            free = on * ~over
        torque = torque * (gain * on)
        mass = data.inertia[k] + armature
        x = _within(q - data.recorded[k], 1.5)
        square = x * x
        torque -= data.gravity[k] * (1.0 - 0.5 * square) + data.slope[k] * x * (1.0 - square / 6.0)
        torque -= data.coupling[k]
        if "spring" in active:
            torque -= of("spring") * q
        if "offset" in active:
            torque -= of("offset")
        for name in linear:
            torque -= of(name) * data.columns[name][k]
        outside = viscous - brake * (1.0 - free) if braked else viscous
        lost = dt * (outside + back_emf * on) + free * damped
        carried = mass - np.minimum(0.5 * lost, mass)
        effective = carried + lost + free * stiff
        v = (carried * v + dt * torque) / effective
        hold = coulomb
        if "load" in active:
            hold = hold + of("load") * data.load[k]
        if "stribeck" in active:
            hold = hold + of("stribeck") * np.exp(-((v / of("stribeck_velocity", 0.1)) ** 2))
        if "asymmetry" in active:
            hold = hold * (1.0 + asymmetry * np.sign(v))
        hold = hold * (dt / effective)
        v -= _within(v, hold)
        q += dt * v
    return out


def _within(x: Array, limit: Array | float) -> Array:
    """x clipped to ± limit; on arrays as small as these several times as fast as `np.clip`."""
    return np.asarray(np.minimum(np.maximum(x, -limit), limit))


def _integral(data: Windows, feed: Array, delay: Array, kp: Array, ki: Array, gain: Array) -> Array:
    """Integral of the error at the start of each window: what holds the arm at first, and the error since then."""
    begun = np.where(feed > 0.5, data.first_torque[1], data.first_torque[0])
    held = (begun / gain - kp * data.first_error) / np.maximum(ki, 1e-9) * (ki > 0.0)
    return np.asarray(data.error_sum - delay * data.travel + held)
