"""Result of a diagnosis (made by `sim_gap.attribution.diagnose`) and its JSON form (docs/formats.md)."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.friction_compensation import Compensation
from sim_gap.attribution.residual_laws import ResidualLaw
from sim_gap.checks.finding import RecordingFinding
from sim_gap.position_gap.training.bands import SHARE, Band
from sim_gap.residuals.location import Location
from sim_gap.search.estimate import Value

HINT = 0.5
"""Largest confidence of a cause in an answer that leaves structure unexplained, and of a law."""
SCHEMA = "armlink.gap/2"
Verdict = Literal["no_gap", "explained", "ambiguous", "unexplained"]


@dataclass(frozen=True)
class Signs:
    """Evidence for and against a cause, on the row that it affects most."""

    evidence: float
    """Loss of score without it, the best replacement in its place: increase of ½ log(R² + floor²)."""
    left: float
    """Share of that row's squared gap that remains above the noise, on held-out data."""
    excess: float
    """RMS that remains there, in units of the relevance floor."""
    elsewhere: float
    """Share of the squared gap that remains over all rows."""
    outside: float = float("inf")
    """How much worse the best general law scores in its place, in units of `evidence`; small if the library may lack
    the true effect."""


@dataclass(frozen=True)
class Cause:
    """One effect with its joints and parameters, and the gap before and after adding it to the earlier causes."""

    effect: str
    joints: tuple[str, ...]
    parameters: dict[str, dict[str, Value]]
    gap_before: float
    gap_after: float
    confidence: float
    fall: float
    """Largest decrease of a joint's held-out RMS when it is added [N·m]; of a hint, at most what is lost without all
    hints together, since of what it took in its turn the surer causes may take most."""
    signs: Signs
    """The signs that the confidence follows from."""
    confounded_with: tuple[str, ...] = ()
    separate_by: str | None = None
    law: str = ""
    """The general law that could best replace it."""

    @property
    def shrink(self) -> float:
        """Relative decrease of the gap by this cause, on held-out data."""
        return 1.0 - self.gap_after / self.gap_before if self.gap_before > 0 else 0.0


@dataclass(frozen=True)
class Rollout:
    """Position gap of the forward simulation against the recording [rad], (n,) before and after the correction."""

    horizon_s: float
    before: Array
    after: Array
    effects: "tuple[EffectRollout, ...]" = ()
    """Those whose absence costs most first."""
    closed_loop: bool = False

    @property
    def worse(self) -> bool:
        """Whether the corrected model is further off over all joints; not where the nominal one cannot run."""
        return bool(np.mean(self.after**2) > np.mean(self.before**2))


@dataclass(frozen=True)
class EffectRollout:
    """Position gap with one effect added to the nominal model alone, and with all effects but this one [rad], (n,)."""

    effect: str
    joints: tuple[str, ...]
    alone: Array
    without: Array


@dataclass(frozen=True)
class Diagnosis:
    """Location of the gap, the effects that cause it, and the gap that remains after adding them."""

    verdict: Verdict
    names: tuple[str, ...]
    where: tuple[Location, ...]
    causes: tuple[Cause, ...]
    minor: tuple[Cause, ...]
    """Further small imperfections: none lowers any joint's gap by a relevant amount."""
    noise_floor: Array
    train_before: Array
    train_after: Array
    heldout_before: Array
    heldout_after: Array
    unexplained: float
    margin: Array
    """RMS per joint from which it is a gap [N·m], (n,)."""
    heldout_is: str
    """Description of the held-out data."""
    left_out: float = 0.0
    """Share of the held-out samples that no row judges."""
    rollout: Rollout | None = None
    laws: tuple[ResidualLaw, ...] = ()
    """Laws of what is left, which no effect of the library accounts for."""
    notes: tuple[str, ...] = ()
    band: Band | None = None
    """90 % band of the motion, where no recording has a torque channel."""
    unit: str = "N·m"
    """Of the gap: N·m, or rad where no recording has a torque channel."""
    friction_compensation: tuple[Compensation, ...] = ()
    """Recordings whose controller compensates friction, by joint."""
    checks: tuple[RecordingFinding, ...] = ()
    """Findings on mapping, units and clocks of the recordings."""
    internals: Any = field(default=None, repr=False, compare=False)
    """Fit and data behind the result (`answer.Internals`), for report and export."""

    @property
    def doubts(self) -> tuple[RecordingFinding, ...]:
        """Findings that were not corrected: the recordings may not be what they are taken for."""
        return tuple(finding for finding in self.checks if not finding.corrected)

    def to_json(self) -> dict[str, Any]:
        """The dictionary of schema armlink.gap/2."""
        roll = self.rollout
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "where": [
                {
                    "joint": place.joint,
                    "channel": place.channel,
                    "regime": place.regime,
                    "rms": _round(place.rms),
                    "noise": _round(place.noise),
                    "share": _round(place.share),
                    **({} if place.hz is None else {"hz": _round(place.hz)}),
                }
                for place in self.where
            ],
            "causes": [*(_cause(cause) for cause in self.causes), *(_law(law, self.names) for law in self.laws)],
            "minor": [_cause(cause) for cause in self.minor],
            "signs": [{name: _round(value) for name, value in vars(cause.signs).items()} for cause in self.causes],
            "gap": {
                "unit": self.unit,
                "joints": list(self.names),
                "noise_floor": _list(self.noise_floor),
                "margin": _list(self.margin),
                "heldout_is": self.heldout_is,
                "train": {"before": _list(self.train_before), "after": _list(self.train_after)},
                "heldout": {"before": _list(self.heldout_before), "after": _list(self.heldout_after)},
            },
            "rollout": {
                "unit": "rad",
                "horizon_s": roll.horizon_s if roll else None,
                "closed_loop": roll.closed_loop if roll else False,
                "before": _list(roll.before) if roll else [],
                "after": _list(roll.after) if roll else [],
                "effects": [
                    {
                        "effect": each.effect,
                        "joints": list(each.joints),
                        "alone": _list(each.alone),
                        "without": _list(each.without),
                    }
                    for each in (roll.effects if roll else ())
                ],
            },
            **({} if self.band is None else {"band": _band(self.band)}),
            "unexplained": _round(self.unexplained),
            "left_out": _round(self.left_out),
            "notes": list(self.notes),
            "friction_compensation": [each.to_json() for each in self.friction_compensation],
            "checks": [finding.to_json() for finding in self.checks],
        }


def _band(band: Band) -> dict[str, Any]:
    values = {"holds": band.holds, "half_width": band.width, "unexplained": band.unexplained}
    return {"share": SHARE, **{name: _list(x) for name, x in values.items()}}


def _cause(cause: Cause) -> dict[str, Any]:
    return {
        "effect": cause.effect,
        "joints": list(cause.joints),
        "parameters": {
            joint: {
                name: {"value": _round(v.value), "ci95": [_round(v.low), _round(v.high)], "unit": v.unit}
                for name, v in values.items()
            }
            for joint, values in cause.parameters.items()
        },
        "gap_before": _round(cause.gap_before),
        "gap_after": _round(cause.gap_after),
        "shrink": _round(cause.shrink),
        "confidence": _round(cause.confidence),
        "confounded_with": list(cause.confounded_with),
        "separate_by": cause.separate_by,
    }


def _law(law: ResidualLaw, names: tuple[str, ...]) -> dict[str, Any]:
    """A law among the causes: named after its quantity, and never surer than a hint."""
    low, high = law.torque - law.band, law.torque + law.band
    return {
        "effect": f"law.{law.quantity}",
        "joints": [names[law.joint]],
        "parameters": {},
        "gap_before": _round(law.before),
        "gap_after": _round(law.after),
        "shrink": _round(1.0 - law.after / law.before),
        "confidence": _round(min(law.share, HINT)),
        "confounded_with": [],
        "separate_by": None,
        "law": {
            "channel": law.channel,
            "directed": law.directed,
            "at": _list(law.at),
            "torque": _list(law.torque),
            "band": [_list(low), _list(high)],
        },
    }


def _round(x: float) -> float | None:
    return float(f"{x:.6g}") if np.isfinite(x) else None


def _list(x: Array) -> list[float | None]:
    return [_round(float(value)) for value in x]
