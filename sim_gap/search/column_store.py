"""Columns of terms on one residual set about an estimate, filtered like the readings, each computed once.

They depend on the torque, the pose and the masses that the arm really has. The search starts with the nominal model's;
a Gauss-Newton step evaluates them about the last estimate (`sim_gap.search.gauss_newton`).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gcomp.arm.inertials import move_mass, point_mass
from gcomp.arrays import Array
from sim_gap.effects.effect import Side
from sim_gap.effects.link import mount_matrix, tilt_gravity
from sim_gap.residuals.layout import ChannelLayout, Columns, Row
from sim_gap.residuals.preprocess import Found, PreparedSignals
from sim_gap.residuals.residual_set import ResidualSet
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


class ColumnStore:
    """Columns of terms: derivatives of the predicted readings at the estimate `values`, else at the nominal model."""

    def __init__(
        self,
        data: ResidualSet,
        values: Values | None = None,
        nominal: "ColumnStore | None" = None,
        pins: Values | None = None,
    ) -> None:
        """`nominal` is the store about the nominal model; `pins` are coefficients that every fit on it keeps."""
        self.data, self.values, self.nominal, self.pins = data, dict(values or {}), nominal, dict(pins or {})
        self._columns: dict[Term, Columns] = {}
        self._offsets: dict[Term, Columns] = {}

    def at(self, values: Values, pins: Values | None = None) -> "ColumnStore":
        return ColumnStore(self.data, values, self.nominal or self, pins)

    @cached_property
    def about(self) -> list[EstimateSignals]:
        return [signals_about(s, self.data.layout, self.values) for s in self.data.signals]

    def release(self) -> None:
        """Free what the columns were computed from and no others will be."""
        for one in self.__dict__.get("about", ()):
            one.signals.release()

    def keep(self, terms: Collection[Term]) -> None:
        """Forget the columns of all other terms; they are evaluated again when they are asked for."""
        kept = {*terms}
        self._columns = {term: x for term, x in self._columns.items() if term in kept}
        self._offsets = {term: x for term, x in self._offsets.items() if term in kept}

    def columns(self, term: Term) -> Columns:
        """Columns per row, (K, p) each; rows that the term does not touch are absent."""
        if term not in self._columns:
            self._compute(term)
        return self._columns[term]

    def offset(self, term: Term) -> Columns:
        """Part of a nonlinear term beside its columns times its coefficients, (K, 1) per row; empty if it is linear."""
        if term not in self._columns:
            self._compute(term)
        return self._offsets[term]

    def masses_in_common(self) -> Columns:
        """Derivatives by a factor that all masses have in common, (K, 1) per row."""
        layout, parts = self.data.layout, list[Columns]()
        for s, one in zip(self.data.signals, self.about, strict=True):
            plain = {(layout.against_model, j): one.signals.bodies[:, j : j + 1] for j in range(layout.n)}
            through = self._through(one, "link", plain) if self.values else plain
            parts.append({row: s.filtered(x) for row, x in layout.compared(through).items()})
        return {row: np.concatenate([part[row] for part in parts]) for row in parts[0]}

    def wide(self, terms: Sequence[Term], row: Row, nonlinear: Collection[Term]) -> Array:
        """Columns of terms in one row, then those beside the nonlinear ones, ordered as `TermEquations.index`."""
        total = sum(self.data.lengths)
        parts = [self.columns(term).get(row) for term in terms]
        own = [
            np.zeros((total, width_of(self.columns(t)))) if x is None else x for t, x in zip(terms, parts, strict=True)
        ]
        beside = [self.offset(term).get(row, np.zeros((total, 1))) for term in terms if term in nonlinear]
        return np.hstack([*own, *beside, np.zeros((total, 0))])

    def _compute(self, term: Term) -> None:
        unchanged = self._of_motion(term)
        if unchanged is not None:
            self._columns[term], self._offsets[term] = unchanged, {}
            return
        found = [self._of(one, term) for one in self.about]
        rows = list(dict.fromkeys(row for own, _ in found for row in own))
        width = max((width_of(own) for own, _ in found), default=0)
        nonlinear = any(beside for _, beside in found)
        parts: dict[Row, list[Array]] = {row: [] for row in rows}
        for s, (own, beside) in zip(self.data.signals, found, strict=True):
            zero, none = np.zeros((len(s.t), width)), np.zeros(len(s.t))
            both = [
                np.column_stack([own.get(row, zero), *([beside.get(row, none)] if nonlinear else [])]) for row in rows
            ]
            pieces = np.split(s.filtered(np.hstack(both)), len(rows), axis=1) if rows else []
            for row, piece in zip(rows, pieces, strict=True):
                parts[row].append(piece)
        whole = {row: np.concatenate(each) for row, each in parts.items()}
        self._columns[term] = {row: x[:, :width] for row, x in whole.items()}
        self._offsets[term] = {row: x[:, width:] for row, x in whole.items()} if nonlinear else {}

    def _of_motion(self, term: Term) -> Columns | None:
        """The nominal model's columns of a term that no estimate changes but by the gain of its motor; None if this one
        has the term, or moves positions."""
        signature = term.form.signature
        moved = any(one.signals.q is not one.signals.read.q for one in self.about)
        if self.nominal is None or not signature.of_motion or term in self.values or moved:
            return None
        own = self.nominal.columns(term)
        gain = self.about[0].motor_gain if signature.side == "motor" else np.ones(self.data.layout.n)
        return {row: x if gain[row[1]] == 1.0 else x * gain[row[1]] for row, x in own.items()}

    def _of(self, one: EstimateSignals, term: Term) -> tuple[Columns, Columns]:
        """Columns of a term in one recording and what it is beside them, at the work rate."""
        layout, signature = self.data.layout, term.form.signature
        values = self.values.get(term)
        if values is not None and signature.slopes is not None:
            plain = signature.slopes(one.signals, layout, term.shape, values)
        else:
            plain = signature.columns(one.entering(term), layout, term.place, term.shape)
        own = self._through(one, signature.side, plain) if self.values else plain
        if values is not None:
            share = one.shares[term]
            beside = {row: share.get(row, 0.0) - own[row] @ values for row in own}
            linear = all(np.allclose(x, 0.0) for x in beside.values())
            beside = {} if linear else beside
        else:
            beside = signature.offset(one.signals, layout, term.shape) if signature.offset else {}
            if not any(np.any(x) for x in beside.values()):
                beside = {}
        return layout.compared(own), layout.compared(beside)

    def _through(self, one: EstimateSignals, side: Side, plain: Columns) -> Columns:
        """Derivatives of the readings: what changes the torque goes through sensor and motor as they are found."""
        layout = self.data.layout
        if side == "motor":
            return {row: x * one.motor_gain[row[1]] for row, x in plain.items()}
        if side == "distortion":
            return {row: x * one.sensor_gain[row[1], row[1]] for row, x in plain.items()}
        if side != "link":
            return plain
        out: Columns = {}
        torque = {joint: x for (_, joint), x in plain.items()}
        if layout.sensor is None:
            return {(channel, j): x * one.motor_slope[:, j, None] for (channel, j), x in plain.items()}
        for i in range(layout.n):
            parts = [one.sensor_gain[i, j] * x for j, x in torque.items() if one.sensor_gain[i, j] != 0.0]
            if not parts:
                continue
            read = np.sum(parts, axis=0)
            out[layout.sensor, i] = read
            if layout.motor:
                made = torque[i] * one.motor_slope[:, i, None] if i in torque else np.zeros_like(read)
                if not np.allclose(made, read):
                    out[layout.motor, i] = made - read
        return out


def width_of(columns: Columns) -> int:
    return next(iter(columns.values())).shape[1] if columns else 0
