"""Derivatives of the rigid arm's torque with respect to one joint's position, velocity and acceleration.

The Newton-Euler recursion, differentiated: a joint changes the motion of the links that it carries, and its position
the frame in which their forces are passed on. Checked against finite differences.
"""

import numpy as np

from gcomp.arrays import Array
from sim_gap.model.rigid_body import Motion, RigidArm, Wrenches, cross, into, out_of, symmetric

Change = tuple[Array, Array, Array]
"""Change of a link's angular velocity, angular acceleration and acceleration of its origin, in its frame, (3, K)."""


def torque_slopes(
    arm: RigidArm, motion: Motion, wrenches: Wrenches, v: Array, joint: int
) -> tuple[Array, Array, Array]:
    """∂τ/∂q, ∂τ/∂v and ∂τ/∂a of one joint, at a motion with velocities v (K, n) and its wrenches, (K, n) each."""
    omega, alpha, push = motion[1][joint]
    none = np.zeros_like(omega)
    axis = none + arm.axis[joint][:, None]
    spin = axis * v[:, joint]
    entering = omega - spin
    turning = cross(entering, axis)
    by_position = turning, cross(alpha - cross(entering, spin), axis) + cross(turning, spin), cross(push, axis)
    force, couple = (cross(axis, parts[joint]) for parts in wrenches)

    def slope(start: Change, turned: tuple[Array, Array] | None = None) -> Array:
        return _passed_on(arm, motion, _below(arm, motion, v, joint, start), joint, turned)

    return slope(by_position, (force, couple)), slope((axis, turning, none)), slope((none, axis, none))


def _below(arm: RigidArm, motion: Motion, v: Array, joint: int, start: Change) -> dict[int, Change]:
    """Changes of all links that a joint carries, from that of its own."""
    turns, moves = motion
    changes = {joint: start}
    for link in range(joint + 1, arm.n):
        up = arm.parent[link]
        if up not in changes:
            continue
        (omega, alpha, push), above, lever = changes[up], moves[up][0], arm.offset[link]
        push = push + cross(alpha, lever) + cross(omega, cross(above, lever)) + cross(above, cross(omega, lever))
        omega, alpha, push = (into(turns[link], x) for x in (omega, alpha, push))
        changes[link] = omega, alpha + cross(omega, arm.axis[link][:, None] * v[:, link]), push
    return changes


def _passed_on(
    arm: RigidArm, motion: Motion, changes: dict[int, Change], joint: int, turned: tuple[Array, Array] | None
) -> Array:
    """Change of every joint's torque with those of the links' motion, (K, n); `turned` is what force and couple of the
    joint change by as its link turns, for those before it."""
    turns, moves = motion
    rows = changes[joint][0].shape[1]
    out, passed = np.zeros((rows, arm.n)), np.zeros((arm.n, 2, 3, rows))
    for link, (omega, alpha, push) in changes.items():
        mass, moment, inertia = arm.inertial[link, 0], arm.inertial[link, 1:4], symmetric(arm.inertial[link, 4:])
        now = moves[link][0]
        bent = cross(omega, cross(now, moment)) + cross(now, cross(omega, moment))
        passed[link, 0] = mass * push + cross(alpha, moment) + bent
        gyro = cross(omega, inertia @ now) + cross(now, inertia @ omega)
        passed[link, 1] = inertia @ alpha + gyro - cross(push, moment)
    for link in reversed(range(arm.n)):
        if link not in changes and not arm.carries[link, joint]:
            continue
        force, couple = passed[link]
        out[:, link] = arm.axis[link] @ couple
        up = arm.parent[link]
        if up < 0:
            continue
        if link == joint and turned is not None:
            force, couple = force + turned[0], couple + turned[1]
        force = out_of(turns[link], force)
        passed[up, 0] += force
        passed[up, 1] += out_of(turns[link], couple) - cross(force, arm.offset[link])
    return out
