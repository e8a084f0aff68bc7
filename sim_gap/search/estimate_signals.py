"""Signals about an estimate: positions, links and torques as the estimate has them, and each effect's exact share.

Columns of effects depend on the torque, the pose and the masses that the arm really has. The search starts with the
nominal model's; a Gauss-Newton step evaluates them about the last estimate (`sim_gap.search.gauss_newton`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gcomp.arm.inertials import move_mass, point_mass
from gcomp.arrays import Array
from sim_gap.effects.link import mount_matrix, tilt_gravity
from sim_gap.residuals.layout import ChannelLayout, Columns
from sim_gap.residuals.preprocess import Found, PreparedSignals
from sim_gap.search.term import Term

Values = Mapping[Term, Array]
"""Coefficients of the terms of an estimate."""


STAGES = (("timing.delay", "torque.crosstalk"), ("torque.hysteresis",), ("torque.deadband",), ("torque.saturation",))
"""Stages of a torque sensor before its gain, in this order: each gets the torque that the one before passes on."""


@dataclass(frozen=True, eq=False)
class EstimateSignals:
    signals: PreparedSignals
    shares: dict[Term, Columns]
    """Torque that each term adds to the rows [N·m], (K,) each, exact; together they are the estimate's prediction."""
    sensor_gain: Array
    """Change of the sensors' readings with the torque of each joint, (n, n)."""
    motor_gain: Array
    """Reported motor torque per torque at the motor, (n,)."""
    motor_slope: Array
    """Change of the reported motor torque with the torque of its joint, (K, n)."""
    stages: tuple[PreparedSignals, ...]
    """The signals with the torque as it enters each stage of the sensors (`STAGES`)."""

    def entering(self, term: Term) -> PreparedSignals:
        """The signals as a term meets them: in a sensor, with the torque that earlier stages pass on."""
        return self.stages[_stage(term)] if term.form.signature.side == "distortion" else self.signals


def signals_about(read: PreparedSignals, layout: ChannelLayout, values: Values) -> EstimateSignals:
    """A recording about an estimate; about nothing, the recording itself."""
    shares = dict[Term, Columns]()
    s, bodies = _bodies(read, layout, values, shares) if values else (read, read.bodies)
    springs = read.arm.spring_torque(read.q)  # the nominal model's at the positions that were read
    for term, c in values.items():
        if term.form.signature.side == "link" and term not in shares:
            _add_to(springs, layout.against_model, _share(shares, s, layout, term, c))
    still = Found(read, bodies + springs, np.zeros_like(read.q), np.zeros_like(read.q), springs)
    s = replace(s, found=still) if values else read
    lost, bent = np.zeros_like(read.q), np.zeros_like(read.q)
    for term, c in values.items():
        if term.form.signature.side == "motor":
            _add_to(lost, layout.motor_side, _share(shares, s, layout, term, c))
    stages: list[PreparedSignals] = []
    for stage in range(len(STAGES)):
        entering = replace(s, found=replace(still, bent=bent.copy())) if bent.any() else s
        stages.append(entering)
        for term, c in values.items():
            if term.form.signature.side == "distortion" and _stage(term) == stage:
                _add_to(bent, layout.sensor, _share(shares, entering, layout, term, c))
    if values:
        s = replace(s, found=replace(still, lost=lost, bent=bent))
    for term, c in values.items():
        if term not in shares:
            _share(shares, s, layout, term, c)
    return EstimateSignals(s, shares, *_gains(s, values), tuple(stages))


def _stage(term: Term) -> int:
    return next(k for k, effects in enumerate(STAGES) if term.effect in effects)


def _share(shares: dict[Term, Columns], s: PreparedSignals, layout: ChannelLayout, term: Term, c: Array) -> Columns:
    """Torque that a term adds to the rows [N·m], (K,) each, which joins the others' shares."""
    columns = term.form.signature.columns(s, layout, term.place, term.shape)
    shares[term] = {row: x @ c for row, x in columns.items()}
    return shares[term]


def _add_to(total: Array, channel: str | None, rows: Columns) -> None:
    """Add what a channel's rows have to a torque of all joints."""
    for (name, joint), share in rows.items():
        if name == channel:
            total[:, joint] += share


def _bodies(
    read: PreparedSignals, layout: ChannelLayout, values: Values, shares: dict[Term, Columns]
) -> tuple[PreparedSignals, Array]:
    """Signals and torque of the links about the estimate (K, n); shares of the terms that change it: masses, gravity,
    positions."""
    channel = layout.against_model
    arm, torque = read.arm, read.bodies
    ours = {term: c for term, c in values.items() if term.form.signature.side == "link"}
    inertial = arm.inertial.copy()
    for term, c in ours.items():
        body = mount_matrix(arm.axis[-1], read.mount) @ c if term.effect == "link.payload" else c
        change = inertial_change(term, body, inertial, read.number)
        if change is not None:
            link = arm.n - 1 if term.effect == "link.payload" else term.place
            inertial[link] += change
            share = read.link_regressor(link) @ change
            torque = torque + share
            shares[term] = {(channel, int(j)): share[:, j] for j in np.flatnonzero(arm.carries[:, link])}
    arm = replace(arm, inertial=inertial)
    for term, c in ours.items():
        if term.effect == "base.tilt":
            turned = tilt_gravity(arm.gravity, c)
            share = arm.gravity_torque(read.q, turned - arm.gravity)
            arm, torque = replace(arm, gravity=turned), torque + share
            shares[term] = {(channel, j): share[:, j] for j in range(arm.n)}
    s = replace(read, arm=arm, found=Found(read, torque, np.zeros_like(read.q), np.zeros_like(read.q)))
    for term, c in ours.items():
        if term.form.signature.moves is not None:
            move = np.einsum("kpd,p->kd", term.form.signature.moves(s, layout, term.place), c)
            unit = np.eye(arm.n)[term.place]
            q, v, a = (x + move[:, k, None] * unit for k, x in enumerate((s.q, s.v, s.a)))
            before, torque = torque, arm.torque(q, v, a)
            share = torque - before
            s = replace(s, q=q, v=v, a=a, found=Found(read, torque, s.found.lost, s.found.bent) if s.found else None)
            shares[term] = {(channel, j): share[:, j] for j in range(arm.n)}
    return s, torque


def inertial_change(term: Term, c: Array, inertial: Array, number: int) -> Array | None:
    """Change of its link's ten parameters by a term with coefficients `c`, the link's being `inertial` (n, 10) before.

    None for a term that does not change them; zero for a body that recording `number` does not have.
    """
    if term.effect == "link.mass_moment":
        return np.asarray(move_mass(inertial[term.place], c) - inertial[term.place])
    if term.effect == "link.inertia":
        return np.asarray(np.concatenate([np.zeros(4), c]))
    if term.effect == "link.payload":
        return np.asarray(point_mass(float(c[0]), c[1:]) * term.present(number))
    return None


def _gains(s: PreparedSignals, values: Values) -> tuple[Array, Array, Array]:
    """How readings of sensor and motor change with the torque: `sensor_gain`, `motor_gain` and `motor_slope`."""
    sensor, motor, slope = np.eye(s.n), np.ones(s.n), np.ones_like(s.q)
    gain = np.ones(s.n)
    for term, c in values.items():
        if term.effect == "torque.crosstalk":
            sensor[term.place, int(term.shape[0]) - 1] += c[0]
        elif term.effect == "torque.gain":
            gain[term.place] += c[0]
        elif term.effect == "actuator.gain":
            motor[term.place] += c[0]
        elif term.effect == "friction.load":
            slope[:, term.place] += c[0] * s.direction[:, term.place] * np.sign(s.model[:, term.place])
    return gain[:, None] * sensor, motor, slope * motor
