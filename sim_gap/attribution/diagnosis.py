"""Result of a diagnosis (made by `sim_gap.attribution.diagnose`) and its JSON form (docs/formats.md)."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.friction_compensation import Compensation
from sim_gap.attribution.residual_laws import ResidualLaw
from sim_gap.checks.finding import RecordingFinding
from sim_gap.position_gap.training.bands import SHARE, Band
from sim_gap.residuals.residual_set import Location
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
    """Fit and data behind the result (`diagnose.Internals`), for report and export."""

    @property
    def doubts(self) -> tuple[RecordingFinding, ...]:
        """Findings that were not corrected: the recordings may not be what they are taken for."""
        return tuple(finding for finding in self.checks if not finding.corrected)

    def to_json(self) -> dict[str, Any]:
        roll: dict[str, Any] = {"horizon_s": None, "closed_loop": False, "before": [], "after": [], "effects": []}
        if self.rollout:
            roll = _fields(self.rollout) | {"effects": [_fields(each) for each in self.rollout.effects]}
        gap = {
            "unit": self.unit,
            "joints": self.names,
            "noise_floor": self.noise_floor,
            "margin": self.margin,
            "heldout_is": self.heldout_is,
            "train": {"before": self.train_before, "after": self.train_after},
            "heldout": {"before": self.heldout_before, "after": self.heldout_after},
        }
        band = self.band and {
            "share": SHARE,
            "holds": self.band.holds,
            "half_width": self.band.width,
            "unexplained": self.band.unexplained,
        }
        answer = {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "where": [_fields(place, "clear", *(["hz"] if place.hz is None else [])) for place in self.where],
            "causes": [*map(_cause, self.causes), *(_law(law, self.names) for law in self.laws)],
            "minor": [*map(_cause, self.minor)],
            "signs": [_fields(cause.signs) for cause in self.causes],
            "gap": gap,
            "rollout": {"unit": "rad", **roll},
            **({"band": band} if band else {}),
            "unexplained": self.unexplained,
            "left_out": self.left_out,
            "notes": self.notes,
            "friction_compensation": [_fields(each) for each in self.friction_compensation],
            "checks": [finding.to_json() for finding in self.checks],
        }
        return {name: plain_json(value) for name, value in answer.items()}


def _fields(record: Any, *left_out: str) -> dict[str, Any]:
    return {name: value for name, value in vars(record).items() if name not in left_out}


def _cause(cause: Cause) -> dict[str, Any]:
    parameters = {
        joint: {name: {"value": v.value, "ci95": (v.low, v.high), "unit": v.unit} for name, v in values.items()}
        for joint, values in cause.parameters.items()
    }
    return {**_fields(cause, "fall", "signs", "law"), "parameters": parameters, "shrink": cause.shrink}


def _law(law: ResidualLaw, names: tuple[str, ...]) -> dict[str, Any]:
    """A law among the causes: named after its quantity, and never surer than a hint."""
    return {
        "effect": f"law.{law.quantity}",
        "joints": [names[law.joint]],
        "parameters": {},
        "gap_before": law.before,
        "gap_after": law.after,
        "shrink": 1.0 - law.after / law.before,
        "confidence": min(law.share, HINT),
        "confounded_with": [],
        "separate_by": None,
        "law": {
            "channel": law.channel,
            "directed": law.directed,
            "at": law.at,
            "torque": law.torque,
            "band": [law.torque - law.band, law.torque + law.band],
        },
    }


def plain_json(value: Any, digits: int = 6) -> Any:
    """Value as in JSON: numbers with so many digits, none that are not finite."""
    if isinstance(value, dict):
        return {name: plain_json(each, digits) for name, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain_json(each, digits) for each in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value
