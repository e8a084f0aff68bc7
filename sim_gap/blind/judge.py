"""Compares one answer with one label: right and wrong effects and joints, parameter errors. Pure functions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

CONFIDENT = 0.8
"""Confidence above which a cause counts as blamed."""
BESIDE_POINT = ("phase", "rest", "source", "other_joint")
"""Parameters that are indices or depend on another one."""

Json = Mapping[str, Any]


@dataclass(frozen=True)
class ParameterError:
    """One estimated parameter: relative error, and whether the 95 % interval contains the true value (None without)."""

    effect: str
    name: str
    relative: float
    inside: bool | None


@dataclass(frozen=True)
class Judgement:
    case: str
    kind: str
    truth: tuple[str, ...]
    withheld: str
    """The effect removed from the library, or empty."""
    verdict: str
    first: str
    """First effect named, effects implied by a true one skipped; empty if none is named."""
    confidence: float
    first_right: bool
    named: bool
    """Whether a true effect is the first or among those confounded with it."""
    tellable: bool
    all_found: bool
    """Whether all true effects are among the causes."""
    blamed: tuple[str, ...]
    """Confident causes that this arm does not have (small true imperfections listed last are excused)."""
    joints: tuple[int, int, int] = (0, 0, 0)
    """Numbers of joints that are right, wrong and missed."""
    errors: tuple[ParameterError, ...] = ()
    shrink: float = float("nan")
    """Claimed relative decrease of the held-out gap at the joint concerned."""
    shrink_true: float = float("nan")
    """Relative decrease of the held-out gap by the true effects."""
    placed: tuple[bool, ...] = ()
    """Of several effects, of each that alone at least doubles the gap of the sound arm somewhere: whether a cause names
    it at one of its true joints."""
    confident: int = 0
    """Number of causes with a confidence above CONFIDENT."""


def judge(answer: Json, label: Json, withheld: str = "") -> Judgement:
    """Judge an answer (docs/formats.md) against its label; `withheld` is the effect that was not in the library."""
    truths = [t for t in label["effects"] if t["effect"] != withheld]
    names = {t["effect"] for t in truths}
    implied = {name for t in label["effects"] for name in t["implied"]}
    causes = list(answer["causes"])
    leading = [c for c in causes if c["effect"] in names or c["effect"] not in implied] or causes
    first = leading[0] if leading else None
    offered = {first["effect"], *(first["confounded_with"] or ())} if first else set()
    shrink, shrink_true = _shrinks(answer, label)
    return Judgement(
        case=label["case"],
        kind=label["kind"],
        truth=tuple(t["effect"] for t in label["effects"]),
        withheld=withheld,
        verdict=answer["verdict"],
        first=first["effect"] if first else "",
        confidence=float(first["confidence"]) if first else 0.0,
        first_right=bool(first and first["effect"] in names),
        named=bool(offered & names),
        tellable=bool(truths) and not any(t["undecided"] for t in truths),
        all_found={t["effect"] for t in label["effects"]} <= names & {c["effect"] for c in causes},
        blamed=_blamed(causes, label, truths, implied),
        joints=_joints(causes, truths),
        errors=tuple(error for t in truths for error in _parameter_errors(causes, t)),
        shrink=shrink,
        shrink_true=shrink_true,
        placed=_placed(causes, label, truths),
        confident=sum(c["confidence"] > CONFIDENT for c in causes),
    )


def _placed(causes: Sequence[Json], label: Json, truths: Sequence[Json]) -> tuple[bool, ...]:
    if label["kind"] != "several":
        return ()
    falls = zip(label["effects"], label["gap"]["falls"], strict=True)
    clear = [t for t, fall in falls if t in truths and fall["before"] > 2.0 * fall["after"]]
    places = [[set(c["joints"]) for c in causes if c["effect"] == t["effect"]] for t in clear]
    return tuple(
        any(not t["joints"] or set(t["joints"]) & joints for joints in named)
        for t, named in zip(clear, places, strict=True)
    )


def _blamed(causes: Sequence[Json], label: Json, truths: Sequence[Json], implied: set[str]) -> tuple[str, ...]:
    """Confident causes that are not true.

    Excused: effects implied by a true one, rivals of an effect that this motion cannot separate, and causes that follow
    every true effect and lower the gap by no more than this arm's small errors do at the same joints.
    """
    due = {t["effect"] for t in truths}
    fine = implied | due | {name for t in truths if t["undecided"] for name in t["confused_with"]}
    out = []
    for cause in causes:
        due.discard(cause["effect"])
        if cause["effect"] in fine or cause["confidence"] <= CONFIDENT:
            continue
        places = [int(joint.removeprefix("joint_")) - 1 for joint in cause["joints"]]
        small = max((rms[j] for rms in label["gap"]["without"].values() for j in places), default=0.0)
        if not due and float(cause["gap_before"] or 0.0) - float(cause["gap_after"] or 0.0) <= small:
            continue
        out.append(str(cause["effect"]))
    return tuple(out)


def _joints(causes: Sequence[Json], truths: Sequence[Json]) -> tuple[int, int, int]:
    """Joints right, wrong and missed, over the true effects of joints: of the cause that names the effect or is
    confounded with it; without one, all are missed."""
    right = wrong = missed = 0
    for truth in truths:
        if not truth["joints"]:
            continue
        effect, true = truth["effect"], set(truth["joints"])
        telling = [c for c in causes if c["effect"] == effect]
        telling += [c for c in causes if effect in (c["confounded_with"] or ())]
        claimed = set(_main_joints(telling[0])) if telling else set[str]()
        right, wrong, missed = right + len(claimed & true), wrong + len(claimed - true), missed + len(true - claimed)
    return right, wrong, missed


def _main_joints(cause: Json) -> list[str]:
    """Joints of a cause whose largest parameter (a gain's distance from 1) is 15 % of that of any joint or more."""
    sizes = {}
    for joint in cause["joints"]:
        values = cause["parameters"].get(joint) or {}
        numbers = [
            _deviation(n, p["value"]) for n, p in values.items() if n not in BESIDE_POINT and p["value"] is not None
        ]
        sizes[joint] = max((abs(x) for x in numbers), default=np.inf)
    limit = 0.15 * max(sizes.values(), default=0.0)
    return [joint for joint, size in sizes.items() if size >= limit or np.isinf(size)]


def _deviation(name: str, value: float) -> float:
    return value - 1.0 if name == "gain" else value


def _parameter_errors(causes: Sequence[Json], truth: Json) -> list[ParameterError]:
    """Relative errors of a true effect's parameters: vectors by their norm, an inertia about the joint's axis."""
    claimed = next((c for c in causes if c["effect"] == truth["effect"]), None)
    out: list[ParameterError] = []
    for joint, true in truth["parameters"].items():
        given = (claimed["parameters"].get(joint) if claimed else None) or {}
        values = {name: p["value"] for name, p in given.items() if name in true and p["value"] is not None}
        if not values:
            continue
        if truth["effect"] in ("link.mass_moment", "link.inertia", "base.tilt"):
            out += _vector_error(truth, true, values)
            continue
        names = [n for n in true if n in values and n not in BESIDE_POINT]
        if truth["effect"] == "link.payload":
            names = ["mass"]
        for name in names:
            size = abs(_deviation(name, true[name]))
            low_high = given[name].get("ci95") or (None, None)
            inside = None if None in low_high else bool(low_high[0] <= true[name] <= low_high[1])
            out.append(ParameterError(truth["effect"], name, abs(values[name] - true[name]) / max(size, 1e-9), inside))
    return out


def _vector_error(truth: Json, true: Json, values: Json) -> list[ParameterError]:
    if truth["effect"] == "link.inertia":
        name, axis = "about_axis", np.array(truth["axis"])
        part = dict(zip("xyz", axis, strict=True))
        weight = {r + c: (1 if r == c else 2) * part[r] * part[c] for r in "xyz" for c in "xyz" if r <= c}
        ours, theirs = (sum(weight[k] * float(source.get(k, 0.0)) for k in weight) for source in (true, values))
        return [ParameterError(truth["effect"], name, abs(theirs - ours) / abs(ours), None)]
    keys = [key for key in true if key in values]
    ours, theirs = np.array([true[k] for k in keys]), np.array([values[k] for k in keys])
    return [
        ParameterError(truth["effect"], "vector", float(np.linalg.norm(theirs - ours) / np.linalg.norm(ours)), None)
    ]


def _shrinks(answer: Json, label: Json) -> tuple[float, float]:
    """Relative decrease of the held-out gap at the joint that the first true effect affects most: claimed and true."""
    falls = label["gap"]["falls"]
    if not falls:
        return float("nan"), float("nan")
    joint, channel = int(falls[0]["joint"].removeprefix("joint_")) - 1, falls[0]["channel"]
    held = answer["gap"]["heldout"]
    before, after = (held[key][joint] if joint < len(held[key]) else None for key in ("before", "after"))
    true = 1.0 - label["gap"]["without"][channel][joint] / label["gap"]["with"][channel][joint]
    return (1.0 - after / before if before and after is not None else float("nan")), true
