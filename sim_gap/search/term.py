"""A term of a fit: one effect at one place with one shape."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from gcomp.arrays import Array
from sim_gap.effects.effect import InverseEffect, Key, Shape
from sim_gap.effects.registry import effects
from sim_gap.residuals.layout import ChannelLayout
from sim_gap.residuals.preprocess import ABSENT


@dataclass(frozen=True)
class Term:
    effect: str
    place: int
    shape: Shape = ()

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.effect, self.place, self.shape))

    def __reduce__(self) -> "tuple[type[Term], tuple[str, int, Shape]]":
        """Without what is cached: effects have functions, and hashes of texts differ from process to process."""
        return Term, (self.effect, self.place, self.shape)

    @cached_property
    def form(self) -> InverseEffect:
        return effects()[self.effect]

    @cached_property
    def key(self) -> Key:
        """Effect and place, for every shape."""
        return self.effect, self.place

    def reshaped(self, entry: int, value: float) -> "Term":
        return Term(self.effect, self.place, (*self.shape[:entry], value, *self.shape[entry + 1 :]))

    @property
    def free(self) -> int | None:
        """The one entry of its shape that is fitted in addition to its coefficients; None if there is none."""
        hints = self.form.hints
        entries = [i for i in range(len(self.shape)) if i not in hints.discrete]
        return entries[0] if len(entries) == 1 and hints.linearised_at is None else None

    def relinearised(self, coefficients: Array) -> "Term":
        """The same term, linearised at its fitted size; unchanged if it is linear."""
        if self.form.hints.linearised_at is None:
            return self
        return Term(self.effect, self.place, self.form.hints.relinearise(coefficients, self.shape))

    @property
    def bound(self) -> tuple[int, ...]:
        """Numbers of the recordings that it is present in, from 1; empty if it belongs to the arm."""
        return self.form.signature.recordings(self.shape)

    def present(self, number: int) -> bool:
        """Whether recording `number` has it: what belongs to the arm is in all of them, a body not in those without."""
        return not self.form.signature.body if number == ABSENT else not self.bound or number in self.bound

    @property
    def start(self) -> "Term":
        """The term whose columns an estimate evaluates about itself: without the secant of a moved position."""
        nonlinear = self.form.hints.linearised_at is not None and self.form.signature.moves is not None
        return Term(self.effect, self.place, (0.0,) * len(self.shape)) if nonlinear else self

    @cached_property
    def beneath(self) -> tuple[Key, ...]:
        return tuple((name, self.place) for name in self.form.needs)


CONSTANT, MASSES, INERTIA, BODY = "actuator.gain", "link.mass_moment", "link.inertia", "link.payload"
OF_LINKS = MASSES, INERTIA, BODY
"""Recordings of motor torque alone know these only up to a common factor: with links twice as heavy and every torque
constant twice as large, the drives report the same."""


def shares_a_factor(layout: ChannelLayout, terms: Sequence[Term]) -> bool:
    """Whether the terms have torque constants that are known only up to a factor common to them and all masses."""
    return layout.sensor is None and any(term.effect == CONSTANT for term in terms)
