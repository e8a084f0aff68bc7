"""Contacts as events: from when, on which link, how strong at least; and loads that are taken up or put down.

The deviation of all joints' rows from what is expected is compared with its largest values in stretches of the arm's
own work: their extreme value distribution gives the threshold for any rate of false alarms. What pushes is then the
hypothesis that explains the change best: a force at a point of some link, or a mass at the hand.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from gcomp.arrays import Array
from gcomp.estimate.posterior import linear_posterior
from gcomp.external.external_model import (
    BEGINNING,
    BLOCK,
    DRIFT,
    ROWS_RATE,
    ExternalModel,
    TorqueRows,
    model_variance,
    slow_weight,
)
from gcomp.external.rigid_motion import LINK_PARAMETERS, RigidMotion, jacobian

FEWEST_MAXIMA = 5
"""Stretches from which a threshold is taken; with fewer, deviations count as normally distributed."""
HEAVIEST = 0.3
"""Largest shape of the extreme value distribution: a choice, as few stretches do not tell it."""
ONE_SIDED_95 = 1.644854
DECIDED = 6
"""Rows until an event's cause is decided: 0.24 s, six time constants of the observer."""
BEGINNING_ROWS = round(BEGINNING * ROWS_RATE)
"""Rows that are not judged: the filter begins with them."""
EVIDENCE = 3.0
"""Logarithm of the odds from which evidence is strong: twenty to one (Kass and Raftery, JASA 90, 1995)."""
ENDED = 0.5
"""Share of the threshold below which an event ends."""
ENDED_ROWS = 8
"""For so many rows in a row."""
LASTING_ROWS = 75
"""Rows after which what still pushes is a load, if that explains it, or belongs to what the arm carries: 3 s."""
POINTS = (0.1, 0.4, 0.7, 1.0)
"""Places of a contact between a link's joint and the next one."""
FORCES = np.geomspace(0.5, 200.0, 8)
"""Standard deviations of a contact's force before it is seen [N]."""
MASSES = np.geomspace(0.05, 20.0, 8)
"""The same of a load's mass [kg]."""
LOAD_REACH = 0.15
"""The same of the place of its centre from the tool's [m]."""
WIDTH = 0.06
"""Half the width of a link [m]: a force acts so far beside the line between its joints."""


EVENT_KINDS = ("contact", "load", "load put down", "contact or load")


@dataclass(frozen=True)
class ContactEvent:
    """A push that begins, or a load that changes."""

    t: float
    """When it began [s]."""
    kind: str
    """Of `EVENT_KINDS`; `contact or load` while no motion has told them apart."""
    joints: tuple[int, ...]
    """Those whose torque it changes beyond what is expected, the most certain first."""
    link: int
    """The likeliest link, from 0."""
    probability: float
    """Of that link, given a contact."""
    odds: float
    """Logarithm of the likelihood of a contact over that of a load."""
    least_force: float
    """95 % lower bound of its force [N], wherever it acts; 0 of a load."""
    mass: float
    """Of a load [kg]; 0 of a contact."""
    told: float
    """When it was decided [s]."""


def threshold(maxima: Array, per_hour: float, joints: int) -> float:
    """Deviation that the arm's own work exceeds so often.

    Generalised extreme values by probability-weighted moments (Hosking, Wallis and Wood, Technometrics 27, 1985).
    """
    from scipy.special import gamma
    from scipy.stats import chi2

    share = min(per_hour * BLOCK / 3600.0, 0.5)
    if len(maxima) < FEWEST_MAXIMA:
        return float(chi2.isf(share / (BLOCK * ROWS_RATE), joints))
    x = np.sort(maxima)
    count = len(x)
    rank = np.arange(count)
    b0, b1 = float(x.mean()), float((rank * x).sum() / (count * (count - 1)))
    b2 = float((rank * (rank - 1) * x).sum() / (count * (count - 1) * (count - 2)))
    c = (2.0 * b1 - b0) / (3.0 * b2 - b0) - np.log(2.0) / np.log(3.0)
    shape = float(np.clip(7.859 * c + 2.9554 * c**2, -HEAVIEST, -1e-3))  # Hosking's sign: negative is heavy
    scale = (2.0 * b1 - b0) * shape / (gamma(1.0 + shape) * (1.0 - 2.0**-shape))
    place = b0 + scale * (gamma(1.0 + shape) - 1.0) / shape
    return float(place + scale / shape * (1.0 - (-np.log1p(-share)) ** shape))


@dataclass(frozen=True, eq=False)
class JudgedRows:
    """Rows beside what is expected of them."""

    external: Array
    """External torque (S, n) [N·m]: what the surroundings push the joints with."""
    std: Array
    """(S, n) [N·m]."""
    change_std: Array
    """Of its change (S, n) [N·m]."""


class ContactDetector:
    """Judges rows one after the other."""

    def __init__(self, model: ExternalModel, per_hour: float = 1.0, tool: Array | None = None) -> None:
        """`tool` (3,) is the point of the last bar frame at which loads are held [m]."""
        self.model = model
        n = model.arm.n
        self.tool = np.zeros(3) if tool is None else tool
        self.lasting_limit, self.sudden_limit = (threshold(each, per_hour / 2.0, n) for each in model.maxima)
        self._lasting_inverse, self._sudden_inverse = model.lasting.precision, model.sudden.precision
        back = np.linalg.inv(model.split)
        self._load_columns = back[:, LINK_PARAMETERS * (n - 1) : LINK_PARAMETERS * (n - 1) + 4]
        self.load = np.zeros(4)
        """Mass [kg] and first moment [kg·m] of what the arm has taken up since."""
        self._slow: Array | None = None
        self._slow_columns: Array | None = None
        self._drift = np.zeros(n)
        self._seen = 0
        self._open: _OpenEvent | None = None

    def judge(self, t: Array, rows: TorqueRows) -> tuple[JudgedRows, list[ContactEvent]]:
        """Rows at times (S,) [s]."""
        model, events = self.model, list[ContactEvent]()
        both = np.concatenate([rows.columns, self._away(rows.columns)])
        own, of_change = np.split(model_variance(both, model.factors), 2)
        std, change_std = model.lasting.std(rows.state, own), model.sudden.std(rows.state, of_change)
        left = -rows.left
        loaded = -(rows.by_link @ self._load_columns)
        external = np.empty_like(left)
        for row in range(len(left)):
            external[row] = left[row] - loaded[row] @ self.load - self._drift
            scaled = external[row] / std[row]
            deviation = float(scaled @ self._lasting_inverse @ scaled)
            at = float(t[row]), external[row], std[row], change_std[row], deviation, loaded[row]
            events += self._row(*at, rows.motion, row)
        return JudgedRows(external, std, change_std), events

    def _away(self, columns: Array) -> Array:
        """Columns (S, n, Q) less what they were before."""
        away = np.empty_like(columns)
        for row, each in enumerate(columns):
            if self._slow_columns is None or self._seen + row < BEGINNING_ROWS:
                self._slow_columns = each.copy()
            np.subtract(each, self._slow_columns, out=away[row])
            self._slow_columns += slow_weight(self._seen + row - BEGINNING_ROWS + 1) * away[row]
        return away

    def _row(
        self, t: float, external: Array, std: Array, change_std: Array, deviation: float, loaded: Array,
        motion: RigidMotion, row: int,
    ) -> Iterator[ContactEvent]:  # fmt: skip
        self._seen += 1
        if self._seen <= BEGINNING_ROWS:
            return
        if self._slow is None:
            self._slow = external.copy() if deviation < self.lasting_limit else 0.0 * external
        change = (external - self._slow) / change_std
        sudden = float(change @ self._sudden_inverse @ change)
        if self._open is None:
            begun = self._seen > 2 * BEGINNING_ROWS
            if deviation > self.lasting_limit or (begun and sudden > self.sudden_limit):
                by_change = begun and sudden / self.sudden_limit >= deviation / self.lasting_limit
                self._open = _OpenEvent(t, self._slow.copy() if by_change else 0.0 * external, by_change)
            else:
                self._slow = self._slow + slow_weight(self._seen - BEGINNING_ROWS) * (external - self._slow)
                self._drift = self._drift + external / (DRIFT * ROWS_RATE)
        opened = self._open
        if opened is not None:
            yield from self._follow(opened, t, external, change_std if opened.by_change else std, loaded, motion, row)
            quiet = deviation < ENDED * self.lasting_limit and sudden < ENDED * self.sudden_limit
            opened.quiet = opened.quiet + 1 if quiet else 0
            lasted = opened.count >= 2 * LASTING_ROWS and deviation < self.lasting_limit
            if self._open is opened and (lasted or opened.quiet >= ENDED_ROWS):
                if opened.event is not None and opened.event.kind == "contact or load" and not lasted:
                    yield from self._end(opened, opened.event, t)
                self._open, self._slow = None, external.copy()

    def _follow(
        self, opened: "_OpenEvent", t: float, external: Array, std: Array, loaded: Array, motion: RigidMotion, row: int
    ) -> Iterator[ContactEvent]:
        opened.rows.append((external - opened.before, std, loaded))
        opened.count += 1
        count, opened.rows = opened.count, opened.rows[-4 * LASTING_ROWS :]
        if count == DECIDED:
            event = self._decide(opened, t, motion, row)
            opened.event = event
            yield event
        if count % LASTING_ROWS == 0 and opened.event is not None:
            taken = self._load(opened)
            if taken is not None:
                before, self.load = self.load, self.load + taken
                self._open, self._slow = None, external - loaded @ taken
                kind = "load" if self.load[0] > before[0] else "load put down"
                if opened.event.kind != kind:
                    yield replace(opened.event, kind=kind, mass=float(taken[0]), told=t, least_force=0.0)

    def _decide(self, opened: "_OpenEvent", t: float, motion: RigidMotion, row: int) -> ContactEvent:
        recent = opened.rows[-3:]
        change, std = np.mean([each[0] for each in recent], axis=0), recent[-1][1]
        spread = self.model.sudden if opened.by_change else self.model.lasting
        covariance = spread.correlation * np.outer(std, std)
        here = motion.part(slice(row, row + 1))
        by_link = np.array(
            [contact_likelihood(self.model, here, link, self.tool, change, covariance) for link in range(len(std))]
        )
        weight = np.exp(by_link - by_link.max())
        link = int(np.argmax(by_link))
        likelihood, load = load_likelihood(recent[-1][2], self.tool, change, covariance)
        opened.decided = _Decided(change, covariance, recent[-1][2], float(by_link.max() + np.log(weight.mean())))
        size = np.abs(change) / std
        order = np.argsort(-size)
        odds = opened.decided.by_contact - likelihood
        kind = "load" if load > 0.0 else "load put down"
        if odds > -EVIDENCE:
            kind = "contact" if odds > EVIDENCE else "contact or load"
        lever = levers(self.model, here, self.tool)
        least = float(np.max((np.abs(change) - ONE_SIDED_95 * std) / lever))
        mass, least = (0.0 if odds > EVIDENCE else load), (0.0 if odds < -EVIDENCE else max(least, 0.0))
        return ContactEvent(
            opened.t, kind, tuple(int(j) for j in order if size[j] > ONE_SIDED_95) or (int(order[0]),), link,
            float(weight[link] / weight.sum()), odds, least, mass, t,
        )  # fmt: skip

    def _end(self, opened: "_OpenEvent", event: ContactEvent, t: float) -> Iterator[ContactEvent]:
        """Whether an event that no longer deviates was a contact that ended, not a load that this pose hides.

        Odds are those of both changes, the one decided by and the one left, which is none after a contact.
        """
        before, recent = opened.decided, opened.rows[-ENDED_ROWS:]
        assert before is not None
        change, (_, std, columns) = np.mean([each[0] for each in recent], axis=0), recent[-1]
        spread = self.model.sudden if opened.by_change else self.model.lasting
        n, covariance = len(std), spread.correlation * np.outer(std, std)
        both = np.zeros((2 * n, 2 * n))
        both[:n, :n], both[n:, n:] = before.covariance, covariance
        by_load, _ = load_likelihood(
            np.vstack([before.columns, columns]), self.tool, np.append(before.change, change), both
        )
        odds = before.by_contact + _normal(change, covariance) - by_load
        if odds > EVIDENCE:
            yield replace(event, kind="contact", mass=0.0, odds=odds, told=t)

    def _load(self, opened: "_OpenEvent") -> Array | None:
        """Load (4,) that explains all rows of an event, if one does."""
        change, std, columns = (np.array(each) for each in zip(*opened.rows, strict=True))
        change, std, columns = change[DECIDED:], std[DECIDED:], columns[DECIDED:]
        columns[..., 0] += columns[..., 1:] @ self.tool
        white = (columns / std[..., None]).reshape(-1, 4) / np.sqrt(ROWS_RATE)
        wanted = (change / std).ravel() / np.sqrt(ROWS_RATE)
        best, found = np.inf, np.zeros(4)
        for size in MASSES:
            own = size * np.array([1.0, *[LOAD_REACH] * 3])
            fitted = linear_posterior(white, wanted, np.zeros(4), own)
            cost = fitted.chi2 + float(np.linalg.slogdet(fitted.information * np.outer(own, own))[1])
            if cost < best:
                best, found = cost, fitted.x
        left = (change - columns @ found) / std
        inverse = self._sudden_inverse if opened.by_change else self._lasting_inverse
        limit = self.sudden_limit if opened.by_change else self.lasting_limit
        misfit = float(np.mean(np.einsum("si,ij,sj->s", left, inverse, left)))
        possible = self.load[0] + found[0] > -0.3 * abs(found[0])
        taken = np.append(found[0], found[1:] + found[0] * self.tool)
        return taken if misfit < ENDED * limit and possible else None


@dataclass(frozen=True, eq=False)
class _Decided:
    """By what an event's cause was decided."""

    change: Array
    """(n,) [N·m]."""
    covariance: Array
    """Of the change without a cause (n, n)."""
    columns: Array
    """Of a load (n, 4)."""
    by_contact: float
    """Logarithm of its likelihood by a contact."""


@dataclass
class _OpenEvent:
    """An event that goes on."""

    t: float
    before: Array
    """External torque before it (n,)."""
    by_change: bool
    rows: list[tuple[Array, Array, Array]] = field(default_factory=list)
    """Change, its standard deviation, and a load's columns, of the newest ones."""
    count: int = 0
    quiet: int = 0
    event: ContactEvent | None = None
    decided: _Decided | None = None


def contact_likelihood(
    model: ExternalModel, motion: RigidMotion, link: int, tool: Array, change: Array, covariance: Array
) -> float:
    """Logarithm of the likelihood of a change (n,) by a force of unknown size and direction somewhere on a link."""
    found = []
    for share in POINTS:
        point = share * (model.arm.span[link] if link < model.arm.n - 1 else tool)
        pull, turn = np.split(jacobian(motion, link, point)[0].T, 2, axis=1)
        unit = pull @ pull.T + WIDTH**2 * turn @ turn.T
        found += [_normal(change, covariance + size**2 * unit) for size in FORCES]
    highest = max(found)
    return highest + float(np.log(np.mean(np.exp(np.array(found) - highest))))


def load_likelihood(columns: Array, tool: Array, change: Array, covariance: Array) -> tuple[float, float]:
    """(Logarithm of the likelihood of a change by a load, its mass [kg]); columns (n, 4) of mass and first moment."""
    at_tool = columns[:, 0] + columns[:, 1:] @ tool
    reach = columns[:, 1:] * LOAD_REACH
    found = [_normal(change, covariance + size**2 * (np.outer(at_tool, at_tool) + reach @ reach.T)) for size in MASSES]
    highest, size = max(found), MASSES[int(np.argmax(found))]
    weighted = np.linalg.solve(covariance + size**2 * reach @ reach.T, at_tool)
    mass = float(weighted @ change / (weighted @ at_tool + size**-2))
    return highest + float(np.log(np.mean(np.exp(np.array(found) - highest)))), mass


def levers(model: ExternalModel, motion: RigidMotion, tool: Array) -> Array:
    """Longest lever (n,) [m] about each joint that a force on the links beyond it has at one pose."""
    tip = motion.origin[0, -1] + motion.rotation[0, -1] @ tool
    points = np.vstack([motion.origin[0], tip])
    out = np.empty(model.arm.n)
    for j in range(model.arm.n):
        away = points[j:] - motion.origin[0, j]
        axis = motion.screw[0, j, :3]
        out[j] = np.linalg.norm(away - np.outer(away @ axis, axis), axis=1).max() + WIDTH
    return out


def _normal(x: Array, covariance: Array) -> float:
    factor = np.linalg.cholesky(covariance)
    white = np.linalg.solve(factor, x)
    return float(-0.5 * white @ white - np.log(np.diag(factor)).sum())
