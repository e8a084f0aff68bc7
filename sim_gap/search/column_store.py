"""Columns of terms on one residual set about an estimate, filtered like the readings, each computed once."""

from collections.abc import Collection, Sequence
from functools import cached_property

import numpy as np

from gcomp.arrays import Array
from sim_gap.residuals.layout import Columns, Row
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.about import About, Values, about
from sim_gap.search.term import Term

UNCHANGED = 1e-12
CLOSE = 0.1
"""Change of the torques, as a share of them, up to which columns of rivals on the links are the nominal model's."""
UNAFFECTED = frozenset(
    {
        "friction.coulomb", "friction.viscous", "friction.stribeck", "friction.asymmetric", "actuator.rotor_inertia",
        "transmission.ripple", "torque.offset", "torque.drift", "actuator.lag", "actuator.delay", "actuator.saturation",
        "law.time", "law.late_drive", "law.motor_velocity", "law.motor_acceleration", "law.motor_position",
    }
)  # fmt: skip
"""Effects whose columns follow from the readings alone, apart from a drive's gain."""


class ColumnStore:
    """Columns of terms: derivatives of the predicted readings at the estimate `values`, else at the nominal model."""

    def __init__(
        self,
        data: ResidualSet,
        values: Values | None = None,
        nominal: "ColumnStore | None" = None,
        pins: Values | None = None,
    ) -> None:
        """`nominal` is the store about the nominal model, of which columns that the estimate does not change are;
        `pins` are coefficients that every fit on these columns keeps."""
        self.data, self.values, self.nominal, self.pins = data, dict(values or {}), nominal, dict(pins or {})
        self._columns: dict[Term, Columns] = {}
        self._offsets: dict[Term, Columns] = {}

    def at(self, values: Values, pins: Values | None = None) -> "ColumnStore":
        """The columns about other values."""
        return ColumnStore(self.data, values, self.nominal or self, pins)

    @cached_property
    def _link_as_nominal(self) -> bool:
        """Whether poses are the nominal ones and torques close to them, so that the links' columns are, too."""
        for one in self.about:
            s, read = one.signals, one.signals.read
            if s.q is not read.q or not np.array_equal(s.arm.gravity, read.arm.gravity):
                return False
            moved = np.sqrt(np.mean((s.model - read.model) ** 2, axis=0))
            if np.any(moved > CLOSE * np.sqrt(np.mean(read.model**2, axis=0))):
                return False
        return all(np.allclose(one.sensor_gain, np.eye(self.data.layout.n), atol=CLOSE) for one in self.about)

    def _as_nominal(self, term: Term) -> bool:
        """Whether a term's columns are those about the nominal model."""
        if self.nominal is None:
            return False
        if term.effect in UNAFFECTED:
            return all(one.motor_gain[term.place] == 1.0 for one in self.about)
        return term not in self.values and term.form.signature.side == "link" and self._link_as_nominal

    @cached_property
    def about(self) -> list[About]:
        """Each recording about the estimate."""
        return [about(s, self.data.layout, self.values) for s in self.data.signals]

    def columns(self, term: Term) -> Columns:
        """Columns per row, (K, p) each; rows that the term does not touch are absent."""
        if term not in self._columns:
            self._compute(term)
        return self._columns[term]

    def offset(self, term: Term) -> Columns:
        """What a nonlinear term is beside its columns times its coefficients, (K, 1) per row; empty if it is linear."""
        if term not in self._columns:
            self._compute(term)
        return self._offsets[term]

    def wide(self, terms: Sequence[Term], row: Row, nonlinear: Collection[Term]) -> Array:
        """Columns of terms in one row, then those beside the nonlinear ones, ordered as `NormalEquations.index`."""
        total = sum(self.data.lengths)
        parts = [self.columns(term).get(row) for term in terms]
        own = [
            np.zeros((total, _width(self.columns(t)))) if x is None else x for t, x in zip(terms, parts, strict=True)
        ]
        beside = [self.offset(term).get(row, np.zeros((total, 1))) for term in terms if term in nonlinear]
        return np.hstack([*own, *beside, np.zeros((total, 0))])

    def _compute(self, term: Term) -> None:
        if self.nominal is not None and self._as_nominal(term):
            self._columns[term], self._offsets[term] = self.nominal.columns(term), self.nominal.offset(term)
            return
        found = [self._of(one, term) for one in self.about]
        rows = list(dict.fromkeys(row for own, _ in found for row in own))
        width = max((_width(own) for own, _ in found), default=0)
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

    def _of(self, one: About, term: Term) -> tuple[Columns, Columns]:
        """Columns of a term in one recording and what it is beside them, at the work rate."""
        layout, signature = self.data.layout, term.form.signature
        values = self.values.get(term)
        if values is not None and signature.slopes is not None:
            plain = signature.slopes(one.signals, layout, term.shape, values)
        else:
            plain = signature.columns(one.signals, layout, term.place, term.shape)
        own = self._through(one, term, plain) if self.values else plain
        if values is not None:
            share = one.shares[term]
            beside = {row: share.get(row, 0.0) - own[row] @ values for row in own}
            small = all(np.abs(x).max(initial=0.0) < UNCHANGED for x in beside.values())
            beside = {} if small else beside
        else:
            beside = signature.offset(one.signals, layout, term.shape) if signature.offset else {}
            if not any(np.any(x) for x in beside.values()):
                beside = {}
        return layout.compared(own), layout.compared(beside)

    def _through(self, one: About, term: Term, plain: Columns) -> Columns:
        """Derivatives of the readings: what changes the torque goes through sensor and motor as they are found."""
        layout, side = self.data.layout, term.form.signature.side
        if side == "motor":
            return {row: x * one.motor_gain[row[1]] for row, x in plain.items()}
        if side == "distortion":
            return {row: x * _own_gain(one, row[1]) for row, x in plain.items()}
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
                if np.abs(made - read).max(initial=0.0) > UNCHANGED:
                    out[layout.motor, i] = made - read
        return out


def _own_gain(one: About, joint: int) -> float:
    return float(one.sensor_gain[joint, joint])


def _width(columns: Columns) -> int:
    return next(iter(columns.values())).shape[1] if columns else 0
