"""The leash of commands with gains: torque and the sum of the law stay within the limit after rounding.

Nothing in a drive with the MIT law bounds kp (q* − q) + kd (dq* − dq) + τ but its own saturation.
"""

import math

from armlink.drives.mit_packing import Grid, MitCommand
from armlink.drives.orders import Limits, Mode, Order, Power

DAMPING_SHARE = 0.9
"""Damping takes at most this share of the torque limit; the rest is for rounding."""
SOFTER, SOFTER_STEPS = 0.8, 30
"""Factor by which both gains are lowered, again and again, while the sum of the law is beyond the limit."""
Steps = tuple[int, int, int, int, int]
ON, POSITION, TORQUE = Power.ON, int(Mode.POSITION), int(Mode.TORQUE)


def order_of(command: MitCommand) -> Order:
    """The order that a command stands for: position control where it has stiffness."""
    position, velocity, kp, kd, torque = command
    return Order(ON, False, POSITION if kp > 0 else TORQUE, position, velocity, torque, kp, kd)


def round_within(command: MitCommand, grid: Grid, limits: Limits, position: float, velocity: float) -> Steps:
    """Steps of a command, moved by as few as it takes to stay within `limits` after rounding.

    `position` and `velocity` are the newest readings (NaN if there are none), by which the sum of the law is bounded;
    the torque alone and the target position are bounded in any case.

    Raises ValueError for numbers that are not finite.
    """
    most = limits.max_torque
    wanted = command.position
    if most < abs(command.torque) < math.inf:
        command = command._replace(torque=math.copysign(most, command.torque))
    q, dq, kp, kd, t = grid.steps(command)
    if kp and limits.lower <= wanted <= limits.upper:
        at = q * grid.q_span / grid.q_most - grid.q
        q += (at < limits.lower) - (at > limits.upper)
    t = _torque_within(t, grid, most)
    if not math.isfinite(position + velocity):
        return q, dq, kp, kd, t
    pull = _pull(q, dq, kp, kd, grid, position, velocity)
    total = pull + t * grid.t_span / grid.t_most - grid.t
    if abs(total) <= most:
        return q, dq, kp, kd, t
    beyond = total - math.copysign(most, total)
    quantum = grid.t_span / grid.t_most
    t = _torque_within(t - math.ceil(abs(beyond) / quantum) * (1 if beyond > 0 else -1), grid, most)
    torque = t * grid.t_span / grid.t_most - grid.t
    for _ in range(SOFTER_STEPS):  # where the torque, limited by itself, cannot keep the sum within the limit
        if abs(pull + torque) <= most:
            return q, dq, kp, kd, t
        kp, kd = int(SOFTER * kp), int(SOFTER * kd)
        pull = _pull(q, dq, kp, kd, grid, position, velocity)
    return q, dq, 0, 0, t


def damping(kd: float, position: float, velocity: float, most: float) -> MitCommand:
    """A command that damps with at most `kd`, and with no more torque than `most` [N·m] at the present velocity."""
    if abs(velocity) * kd > DAMPING_SHARE * most:
        kd = DAMPING_SHARE * most / abs(velocity)
    return MitCommand(position if math.isfinite(position) else 0.0, 0.0, 0.0, kd, 0.0)


def _pull(q: int, dq: int, kp: int, kd: int, grid: Grid, position: float, velocity: float) -> float:
    """Torque of both gains where the drive stands [N·m]."""
    stiff = kp * grid.kp / grid.kp_most * (q * grid.q_span / grid.q_most - grid.q - position)
    return stiff + kd * grid.kd / grid.kd_most * (dq * grid.v_span / grid.v_most - grid.v - velocity)


def _torque_within(steps: int, grid: Grid, most: float) -> int:
    """Steps of a torque, moved inwards until it is within ±most [N·m] and the range."""
    steps = max(0, min(int(grid.t_most), steps))
    torque = steps * grid.t_span / grid.t_most - grid.t
    if abs(torque) <= most:
        return steps
    bound = math.copysign(most, torque)
    steps = round((bound + grid.t) / grid.t_span * grid.t_most)
    beyond = abs(steps * grid.t_span / grid.t_most - grid.t) > most  # the limit lies between two steps
    return steps - (1 if torque > 0 else -1) * beyond
