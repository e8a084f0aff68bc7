"""Bodies that only some recordings have: which of the held-out recordings were made with them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armlink.errors import BadInput
from sim_gap.residuals.preprocess import ABSENT
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.estimate import Estimate
from sim_gap.search.term import Term


def groups_of(given: Sequence[str], labels: Sequence[str]) -> list[tuple[str, ...]]:
    """Names of the groups that each recording belongs to, from `NAME=REC[,REC…]` and the recordings' labels (paths).

    REC is a path as given, a file name, or a file name without suffixes. Raises BadInput for a recording that is not
    among them.
    """
    out: list[list[str]] = [[] for _ in labels]
    for one in given:
        name, found, members = one.partition("=")
        if not (name and found and members):
            raise BadInput(f"--group {one}: expected NAME=REC[,REC…], such as loaded=a.csv,b.csv")
        for member in members.split(","):
            numbers = [k for k, label in enumerate(labels) if member in _names(label)]
            if not numbers:
                raise BadInput(f"--group {one}: {member} is none of the recordings {', '.join(labels)}")
            for k in numbers:
                out[k].append(name)
    return [tuple(names) for names in out]


def _names(label: str) -> tuple[str, ...]:
    file = label.rsplit("/", 1)[-1]
    return label, file, file.split(".", 1)[0]


def placed(estimate: Estimate, heldout: ResidualSet) -> ResidualSet:
    """The held-out recordings, each numbered by whether it was made with the body that training recordings have.

    By its groups if there are any; else by the sum of squares that remains with and without the body. A recording that
    is a part of a training recording stays as it is.
    """
    bodies = [term for term in estimate.terms if term.effect == "link.payload"]
    known = {s.number for s in estimate.store.data.signals}
    if not bodies or all(s.number in known for s in heldout.signals):
        return heldout
    (body,) = bodies
    with_it = next(s for s in estimate.store.data.signals if body.form.signature.present(body.shape, s.number))
    others = [s.groups for s in estimate.store.data.signals if body.form.signature.present(body.shape, s.number)]
    out = []
    for s in heldout.signals:
        if s.number in known:
            out.append(s)
            continue
        present, absent = replace(s, number=with_it.number), replace(s, number=ABSENT)
        if any(others) and body.bound:
            out.append(present if any({*s.groups} & {*names} for names in others) else absent)
        else:
            left = [_left(estimate, ResidualSet((each,), heldout.layout)) for each in (present, absent)]
            out.append(absent if left[1] < left[0] else present)
    return ResidualSet(tuple(out), heldout.layout)


def _left(estimate: Estimate, data: ResidualSet) -> float:
    """Σ ½ log(R² + floor²) over the rows that remains of one recording."""
    explained = estimate.predict(data)
    total = 0.0
    for row in data.rows:
        if (valid := data.valid[row]).any():
            rest = (data.values[row] - explained[row])[valid]
            total += 0.5 * float(np.log(np.mean(rest**2) + data.relevance_floor[row] ** 2))
    return total


def recordings_with(term: Term, sets: Sequence[ResidualSet]) -> tuple[str, ...]:
    """Labels of the recordings that have a term; empty if all of them do."""
    every = list(
        dict.fromkeys((s.label, term.form.signature.present(term.shape, s.number)) for d in sets for s in d.signals)
    )
    return () if all(present for _, present in every) else tuple(label for label, present in every if present)
