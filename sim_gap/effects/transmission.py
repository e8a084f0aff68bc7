"""Errors of the transmission between motor and torque sensor.

In one that gives, the position sensor is at the motor, and the link is at another angle, q − δ: δ = τ/K for elasticity;
for backlash half the play, in the direction of the transmitted torque.
"""

from collections.abc import Sequence

import numpy as np

from gcomp.arm.rigid_body import CREEP
from gcomp.arrays import Array
from sim_gap.effects.effect import (
    Beneath,
    InverseEffect,
    Key,
    Plausibility,
    SearchHints,
    Shape,
    Signature,
)
from sim_gap.effects.position import position_effect
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import PreparedSignals

ALWAYS, MOST, SLOWLY = 24, 64, 0.25
"""Most cycles per radian of a ripple that is searched for: in any case, and if a joint turns slowly enough."""
NOISY = 0.05
"""Largest noise of a sensor, as a share of the joint's torque (RMS), for its reading to be used."""
SETTLED = 0.02
"""Share of the largest torque within which the play is crossed."""


def _ripple(s: PreparedSignals, joint: int, shape: Shape) -> Array:
    """Motor torque periodic in the position of the gear: amplitude·sin(cycles·q + phase)."""
    angle = shape[0] * s.q[:, joint]
    return np.column_stack([np.sin(angle), np.cos(angle)])


def _cycles(signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
    """Up to ALWAYS cycles per radian; up to MOST, as far as the joint turns slowly enough during a share SLOWLY of its
    motion for them to be within the pass band."""
    speed = np.concatenate([np.abs(s.v[s.moving[:, place] > 0, place]) for s in signals])
    slow = float(np.quantile(speed, SLOWLY)) if len(speed) else np.inf
    shown = 2.0 * np.pi * min(s.band for s in signals) / max(slow, CREEP)
    return tuple((float(cycles),) for cycles in range(4, int(min(max(shown, ALWAYS), MOST)) + 1, 2))


def _spring(s: PreparedSignals, joint: int, _shape: Shape) -> Array:
    """A spring across the joint, such as a cable bundle: torque linear in position on the link side."""
    q = s.q[:, joint]
    return np.column_stack([q, np.ones_like(q)])


def _stiffness_and_rest(coefficients: Array, _shape: Shape, _beneath: Beneath) -> Array:
    stiffness = float(coefficients[0])
    return np.array([stiffness, -coefficients[1] / (stiffness if abs(stiffness) > 1e-9 else np.inf)])


def _coupling(signals: PreparedSignals, layout: ChannelLayout, place: int, shape: Shape) -> Columns:
    """The motor of this joint also turns with another joint, by q_i + c·q_j: its inertia and friction follow that speed
    and load joint j through the same lever c."""
    other, lever = int(shape[0]) - 1, shape[1]
    speed = signals.v[:, place] + lever * signals.v[:, other]
    push = signals.a[:, place] + lever * signals.a[:, other]
    shared = np.column_stack([push, np.clip(speed / CREEP, -1.0, 1.0), speed])
    return {(layout.motor_side, place): shared, (layout.motor_side, other): lever * shared}


def _neighbours(signals: Sequence[PreparedSignals], place: int) -> tuple[Shape, ...]:
    neighbours = [place + step for step in (-1, 1) if 0 <= place + step < signals[0].n]
    return tuple((float(other + 1), lever) for other in neighbours for lever in (-1.0, -0.6, 0.6, 1.0))


def _outer_joint(place: int, shape: Shape) -> tuple[int, Shape]:
    """At a lever of ±1 the motors of both joints show alike: it is reported at the outer joint, as in wrists."""
    other, lever = int(shape[0]) - 1, shape[1]
    return (other, (float(place + 1), lever)) if abs(lever) == 1.0 and other > place else (place, shape)


def _own_rotors(_layout: ChannelLayout, place: int, shape: Shape) -> tuple[Key, ...]:
    own = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia")
    return tuple((effect, joint) for joint in (place, int(shape[0]) - 1) for effect in own)


def transmitted(signals: PreparedSignals, layout: ChannelLayout, joint: int) -> Array:
    """Torque through the transmission, smooth, (K,): the sensor's; the model's if there is none or it is noisy.

    Noise of the reading would explain itself.
    """
    model, sensor = signals.model[:, joint], layout.sensor
    clear = sensor and signals.noise[sensor][joint] < NOISY * np.sqrt(np.mean(model**2))
    return signals.calm(signals.reading[sensor][:, joint] if sensor and clear else model)


def _bend(signals: PreparedSignals, layout: ChannelLayout, place: int) -> Array:
    """A spring between motor and link; the coefficient is its compliance."""
    bend = transmitted(signals, layout, place)
    speed = np.gradient(bend, 1.0 / signals.rate)
    return -np.stack([bend, speed, np.gradient(speed, 1.0 / signals.rate)], axis=-1)[:, None]


def _play(signals: PreparedSignals, layout: ChannelLayout, place: int) -> Array:
    """Play between motor and link; the coefficient is its full width."""
    torque = transmitted(signals, layout, place)
    side = np.clip(torque / (SETTLED * np.abs(torque).max() + 1e-9), -1.0, 1.0)
    return -0.5 * np.stack([side, 0.0 * side, 0.0 * side], axis=-1)[:, None]


EFFECTS = (
    InverseEffect(
        "transmission.ripple",
        Signature.at_motor(_ripple, of_motion=True),
        hints=SearchHints(shapes_for=_cycles),
        parameters_of=lambda c, shape, _: [np.hypot(*c), shape[0], np.arctan2(c[1], c[0])],
    ),
    InverseEffect(
        "transmission.spring",
        Signature.at_link(_spring),
        Plausibility(bounds=(np.array([0.0, -np.inf]), np.inf)),
        parameters_of=_stiffness_and_rest,
    ),
    InverseEffect(
        "transmission.coupling",
        Signature(_coupling, side="motor", of_motion=True),
        Plausibility(background_std=np.array([0.0, 0.03, 0.02]), background_nm=True, bounds=(0.0, np.inf)),
        SearchHints(shapes_for=_neighbours, discrete=frozenset({0}), alternatives=_own_rotors, canonical=_outer_joint),
        parameters_of=lambda c, shape, _: [shape[1], shape[0], *c],
    ),
    InverseEffect(
        "transmission.elasticity",
        position_effect(_bend),
        Plausibility(bounds=(0.0, np.inf)),
        parameters_of=lambda compliance, _shape, _: 1.0 / np.maximum(compliance, 1e-12),
    ),
    InverseEffect("transmission.backlash", position_effect(_play), Plausibility(bounds=(0.0, 0.3))),
)
