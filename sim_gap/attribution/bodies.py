"""Bodies that only some recordings have: which of them were made with one, and how it was mounted."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armlink.errors import BadInput
from gcomp.arrays import Array
from sim_gap.attribution.verdict import NEAR
from sim_gap.residuals.preprocess import ABSENT, PreparedSignals
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.column_store import ColumnStore
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.model_selection import AGAIN
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
            raise BadInput(f"--group {one}: expected NAME=REC[,REC…], for example loaded=a.csv,b.csv")
        for member in members.split(","):
            numbers = [k for k, label in enumerate(labels) if member in _names(label)]
            if not numbers:
                raise BadInput(f"--group {one}: {member} is not one of the recordings {', '.join(labels)}")
            for k in numbers:
                out[k].append(name)
    return [tuple(names) for names in out]


def _names(label: str) -> tuple[str, ...]:
    file = label.rsplit("/", 1)[-1]
    return label, file, file.split(".", 1)[0]


def body_of(estimate: EffectEstimate) -> Term | None:
    """The body that recordings differ in, if one was found."""
    return next((term for term in estimate.terms if term.effect == "link.payload"), None)


def numbered_by_body(estimate: EffectEstimate, heldout: ResidualSet) -> ResidualSet:
    """The held-out recordings, each numbered by whether it was made with the body that training recordings have, and
    with the angle by which that is turned about the last joint's axis.
    """
    body = body_of(estimate)
    train = estimate.store.data.signals
    known = {s.number: s for s in train}
    if body is None or all(s.number in known for s in heldout.signals):
        return heldout
    with_it = next(s for s in train if body.present(s.number))
    others = [s.groups for s in train if body.present(s.number)]
    out = []
    for s in heldout.signals:
        if s.number in known:
            out.append(replace(s, mount=known[s.number].mount))
            continue
        tried = [replace(s, number=with_it.number), replace(s, number=ABSENT)]
        if any(others) and body.bound:
            tried = tried[:1] if any({*s.groups} & {*names} for names in others) else tried[1:]
        left = [_left(estimate, ResidualSet((each,), heldout.layout)) for each in tried]
        best = tried[int(np.argmin(left))]
        if tried[0].number != ABSENT:
            alone = ResidualSet((tried[0],), heldout.layout)
            own, _ = _own(estimate, estimate.on(alone), body, 0)
            turned = replace(tried[0], mount=_turn(s, estimate.of(body), own))
            best = turned if _left(estimate, replace(alone, signals=(turned,))) < min(left) - AGAIN else best
        out.append(best)
    return ResidualSet(tuple(out), heldout.layout)


TURNED = 0.25
"""Least angle by which a body counts as mounted in another way [rad]."""
ALIKE = 0.5
"""Largest difference of two bodies' mass and moment, as a share of the larger, for one to be the other, turned."""
OF_A_BODY = 0.1
"""Largest share of the squares that a body leaves of a gap that is one."""


def mounts(estimate: EffectEstimate) -> tuple[float, ...]:
    """Angle by which the body is turned in each training recording against the first that has it [rad]."""
    body, data = body_of(estimate), estimate.store.data
    angles = [s.mount for s in data.signals]
    have = [k for k, s in enumerate(data.signals) if body and body.present(s.number)]
    owns = [_own(estimate, estimate.store, body, k)[0] for k in have] if body and len(have) > 1 else []
    for k, own in zip(have, owns, strict=False):
        angle = _turn(data.signals[k], owns[0], own)
        angles[k] += angle if abs(angle) > TURNED else 0.0
    return tuple(angles)


def _own(estimate: EffectEstimate, store: ColumnStore, body: Term, recording: int) -> tuple[Array, float]:
    """Mass and first moment (4,) of the body in one recording of a set, all else as in the estimate, and the share of
    the squares of the rows with a gap that it leaves; one without a gap."""
    data = store.data
    explained = estimate.predict(data, store)
    part = data.parts[recording]
    gram, side, rows = np.zeros((4, 4)), np.zeros(4), []
    for row, columns in store.columns(body).items():
        valid = data.valid[row][part]
        x, y = columns[part][valid], (data.values[row] - explained[row])[part][valid]
        if len(y):
            weight = 1.0 / (np.mean(y**2) + data.relevance_floor[row] ** 2)
            rows.append((x, y, data.margin[row] ** 2))
            gram, side = gram + weight * x.T @ x, side + weight * x.T @ y
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-12))
    change = scale * np.linalg.lstsq(gram * scale * scale[:, None], scale * side, 1e-8)[0]
    gaps = [np.sum((y - x @ change) ** 2) / (y @ y) for x, y, margin in rows if np.mean(y**2) > NEAR**2 * margin]
    found = estimate.of(body) if body in estimate.terms else np.zeros(4)
    return found + change, float(np.mean(gaps)) if gaps else 1.0


def _turn(s: PreparedSignals, one: Array, other: Array) -> float:
    """Angle about the last joint's axis from a body (mass, moment) to another; zero if they are different bodies."""
    axis = s.arm.axis[-1]
    across = [body[1:] - (body[1:] @ axis) * axis for body in (one, other)]
    sizes = [np.array([abs(b[0]), np.linalg.norm(r)]) for b, r in zip((one, other), across, strict=True)]
    most = np.maximum(*sizes)
    if one[0] * other[0] <= 0.0 or np.any(np.abs(sizes[0] - sizes[1]) > ALIKE * most):
        return 0.0
    return float(np.arctan2(np.cross(across[0], across[1]) @ axis, across[0] @ across[1]))


def recordings_with_another_body(estimate: EffectEstimate, heldout: ResidualSet) -> list[int]:
    """Indices of held-out recordings that differ from all training recordings by a body.

    Nothing in the training data then separates the body from errors of the arm's own masses: all of them have one that
    a held-out recording lacks, or a gap of a held-out recording is nearly all that of a body.
    """
    body, known = body_of(estimate), {s.number for s in estimate.store.data.signals}
    if body is None:
        trial = Term("link.payload", 0)
        others = [(k, s) for k, s in enumerate(heldout.signals) if s.number not in known]
        owns = {k: _own(estimate, estimate.on(ResidualSet((s,), heldout.layout)), trial, 0) for k, s in others}
        return [k for k, (_, left) in owns.items() if left < OF_A_BODY]
    if not all(body.present(number) for number in known):
        return []
    return [k for k, s in enumerate(heldout.signals) if s.number == ABSENT]


def _left(estimate: EffectEstimate, data: ResidualSet) -> float:
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
    every = list(dict.fromkeys((s.label, term.present(s.number)) for d in sets for s in d.signals))
    return () if all(present for _, present in every) else tuple(label for label, present in every if present)
