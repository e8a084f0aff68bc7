"""Campaign: external torque of drawn arms at work: bounds that hold, false contacts, forces found, loads told apart.

    python tests/campaigns/external_torque.py [--draws 10] [--first 1] [--minutes 60] [--only link motor]

A draw is four arms: link sensors at realism 0, 1 and 3, and quasi-direct drives of 4 to 7 joints with all that the
creep campaign hides. Each has the records that its calibration leaves, works ten minutes without contact, from which
its own bounds are learned, and is then judged in work that is new: without contact, with pushes of 1.5 times the told
smallest force, and with loads taken up and put down.

Beside it, on the same work and at the same rate of false alarms, stand a momentum observer with the maker's masses,
and one with the records' gains, gravity and friction, both with constant thresholds. Exit status 1 if a bound fails.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))

from bounds import exit_status
from drawn_arms import drawn_arm
from drawn_creeps import draw_creep
from drawn_motion import RATE, DrawnMotion, Load, Motion, Push, ordinary_motion
from judged_creeps import creep_arm
from real_arm import RealArm
from scipy.signal import lfilter

from armlink.torque_calibration import TorqueCalibration
from calib.arm.kinematics import StatedModel, gcomp_arm
from calib.external.arm_model import ArmListener, ArmRecords, listener_of, prior_of
from calib.external.listening import Heard, WrenchFrame, listen
from calib.fit.creep_fit import fit_rows
from calib.plan.creep_plan import plan_creep
from calib.records.records import (
    CalibrationRecord,
    Discrepancy,
    GravityRecord,
    JointCalibration,
    matrix,
    provenance,
)
from gcomp.arm.mass_moments import base_parameters
from gcomp.external.contact import ContactDetector, threshold
from gcomp.external.external_model import BEGINNING, CHUNK, ROWS_RATE, block_maxima
from gcomp.external.filtered_rows import BANDWIDTH, RowFilter
from gcomp.external.rigid_motion import LINK_PARAMETERS
from gcomp.external.wrench import force_found

BASELINE = 600.0
"""Of work to learn from [s]."""
EVERY, LASTS = 6.0, 0.7
"""Time from push to push, and how long one lasts [s]."""
FOUND_WITHIN = 0.3
STRONGEST = 150.0
"""A push that would have to be stronger to be told is not made [N]."""
LENGTH = 0.05
"""A link that is shorter has no surface to push [m]."""
TIMES_TOLD = 1.5
MAKER = 0.1
"""Standard deviation of a maker's masses, as a share."""
LEVELS = (0.0, 1.0, 3.0)
COVERAGE = (0.93, 0.97)
FOUND, RIGHT_LINK, HALF = 0.95, 0.8, 0.5


@dataclass
class Arm:
    """A drawn arm with its records."""

    name: str
    motion: DrawnMotion
    records: ArmRecords
    nominal: np.ndarray
    """Inertial parameters (n, 10) as the maker has them."""

    def recording(self, motion: Motion, pushes=(), loads=()):
        made = self.motion.record(motion, pushes, loads)
        if made.motor_torque is None:
            return made
        n = made.n
        held = self.records.calibration.torque_calibration(TorqueCalibration(np.ones(n), np.zeros(n)))
        return type(made)(**{**made.__dict__, "motor_torque": held.invert(made.motor_torque)})


def maker_links(links, random) -> np.ndarray:
    """Of the arm file's links (n, 10), about the joints."""
    out = np.zeros((len(links), LINK_PARAMETERS))
    for k, link in enumerate(links):
        mass, com = link.mass * (1 + MAKER * random.normal()), np.array(link.com)
        about = np.diag(link.inertia[:3]) + mass * (com @ com * np.eye(3) - np.outer(com, com))
        out[k] = [mass, *(mass * com), *about[np.triu_indices(3)]]
    return out


def link_arm(seed: int, level: float) -> Arm:
    file = drawn_arm(seed)[0]
    source = RealArm(file, level, seed)
    kinematics, same = gcomp_arm(file), provenance(file)
    joints = tuple(
        JointCalibration(
            name=name, gain=1.0, offset=0.0, position_gain=1.0, position_offset=0.0,
            discrepancy=Discrepancy(level=float(lack), level_std=0.2 * float(lack), length=1.0),
        )
        for name, lack in zip(kinematics.names, source.level, strict=True)
    )  # fmt: skip
    gravity = GravityRecord(
        **same, names=kinematics.names, beta=tuple(source.model.tolist()), covariance=matrix(source.covariance),
        identifiable=(True,) * (2 * kinematics.n), gravity=tuple(kinematics.gravity.tolist()),
    )  # fmt: skip
    records = ArmRecords(
        StatedModel(kinematics, None, None, None, file), CalibrationRecord(**same, joints=joints), gravity
    )
    random = np.random.default_rng([seed, 61])
    moving = DrawnMotion(source, random, source.rated, kinematics.lower, kinematics.upper)
    return Arm(f"link sensors, realism {level:g}", moving, records, maker_links(file.sim.links, random))


def motor_arm(seed: int) -> Arm:
    file = creep_arm(seed)
    plan = plan_creep(file)
    made = draw_creep(file, plan, seed, plan.reference_mass)
    kinematics, rated = gcomp_arm(file), file.require_link().rated_torques
    fit = fit_rows(kinematics, made.rows, rated)
    calibration = fit.record(file)
    gravity = fit.gravity.record(file, calibration)
    records = ArmRecords(StatedModel(kinematics, None, None, None, file), calibration, gravity)
    random = np.random.default_rng([seed, 62])
    made.simulated.detach_mass()
    moving = DrawnMotion(made, random, rated, kinematics.lower, kinematics.upper, made.simulated.time)
    return Arm("motor currents", moving, records, maker_links(file.sim.links, random))


@dataclass
class Outcome:
    """What one arm came to."""

    rest: np.ndarray
    """Whether each row at rest is within its bounds."""
    moving: np.ndarray
    false: int
    hours: float
    pushed: int
    found: int
    right: int
    loads: int
    loads_told: int
    load_contacts: int
    needed: dict[str, float]
    """Force along a random direction that is found in 95 % [N], by method."""


def judge(arm: Arm, seconds: float) -> Outcome:
    random, kinematics = arm.motion.random, arm.records.stated.arm
    low, high = kinematics.lower, kinematics.upper
    free = ordinary_motion(low, high, BASELINE, random)
    baseline = arm.recording(free)
    work = ordinary_motion(low, high, seconds, random)
    quiet = arm.recording(work)
    listener = listener_of(arm.records, [baseline], [quiet])
    frame = WrenchFrame(kinematics.n - 1, np.array([0.0, 0.0, 0.1]))
    heard = next(iter(listen(listener, quiet, frame, 1.0)))
    first = round(BEGINNING * ROWS_RATE)
    within = (np.abs(heard.judged.external) < 1.96 * heard.judged.std)[first:]
    still = ~np.interp(heard.t, work.t, work.moving.astype(float))[first:].astype(bool)
    pushes = draw_pushes(arm, listener, work, heard, random)
    needed = forces_needed(arm, listener, baseline, quiet, work, heard, pushes, frame)
    pushed = next(iter(listen(listener, arm.recording(work, pushes=[p for p, _ in pushes]), frame, 1.0)))
    found, right = 0, 0
    long = np.linalg.norm(kinematics.span[:-1], axis=1) >= LENGTH
    place = np.concatenate([[0], np.cumsum(long)])
    """Number of the link among those that have a length: one without, as in a wrist, is its neighbours' end."""
    for push, _ in pushes:
        own = [e for e in pushed.events if push.begin - 0.02 <= e.t <= push.begin + FOUND_WITHIN]
        found += bool(own)
        right += bool(own) and abs(place[own[0].link] - place[push.link]) <= 1
    loads = draw_loads(arm, work, random)
    carried = next(iter(listen(listener, arm.recording(work, loads=loads), frame, 1.0)))
    near = [
        any(abs(e.t - when) < 5.0 and e.kind != "contact" for e in carried.events)
        for load in loads
        for when in (load.begin, load.end)
    ]
    contacts = sum(e.kind == "contact" for e in carried.events)
    return Outcome(
        within[still], within[~still], len(heard.events), seconds / 3600.0, len(pushes), found, right, len(near),
        sum(near), contacts, needed,
    )  # fmt: skip


def draw_pushes(arm: Arm, listener: ArmListener, work: Motion, heard: Heard, random) -> list[tuple[Push, float]]:
    """Pushes at 1.5 times the told smallest force, and that force."""
    detector, n = ContactDetector(listener.model, 1.0), arm.records.stated.arm.n
    motion = rows_of(listener, work)
    out = []
    for begin in np.arange(5.0, work.t[-1] - 2.0, EVERY):
        begin = float(begin + random.uniform(-1.0, 1.0))
        row = int(np.searchsorted(heard.t, begin + 0.2))
        for _ in range(20):
            link = int(random.integers(n))
            share = random.uniform(0.3, 1.0)
            span = arm.records.stated.arm.span[link]
            if link < n - 1 and np.linalg.norm(span) < LENGTH:
                continue
            point = share * span if link < n - 1 else np.array([0.0, 0.0, 0.1 * share])
            way = random.normal(size=3)
            way /= np.linalg.norm(way)
            here = motion.part(slice(row, row + 1))
            told = float(force_found(detector, here, link, point, way, heard.judged.change_std[row][None])[0])
            if told < STRONGEST / TIMES_TOLD:
                out.append((Push(begin, begin + LASTS, link, point, TIMES_TOLD * told * way), told))
                break
    return out


def rows_of(listener: ArmListener, work: Motion):
    from gcomp.external.external_model import stride_of
    from gcomp.external.rigid_motion import rigid_motion

    chosen = slice(0, None, stride_of(listener.rate))
    return rigid_motion(listener.model.arm, work.q[chosen], work.v[chosen])


def draw_loads(arm: Arm, work: Motion, random) -> list[Load]:
    """Taken up in one pause and put down in the next but one."""
    links = arm.nominal
    ends = np.flatnonzero(np.diff(work.moving.astype(int)) == -1)
    starts = np.flatnonzero(np.diff(work.moving.astype(int)) == 1)
    pauses = [(work.t[a], work.t[b]) for a in ends for b in starts[starts > a][:1] if work.t[b] - work.t[a] > 1.2]
    out = []
    for (begin, _), (end, _) in zip(pauses[1::4], pauses[3::4], strict=False):
        mass = random.uniform(0.05, 0.2) * links[:, 0].sum() / 2
        point = np.array([0.0, 0.0, 0.1]) + random.uniform(-0.05, 0.05, 3)
        out.append(Load(float(begin + 0.6), float(end + 0.6), float(mass), point))
    return out


def forces_needed(arm, listener, baseline, quiet, work, heard, pushes, frame) -> dict[str, float]:
    """By method: the size of these pushes from which 95 % would have been found within 0.3 s, at equal false alarms."""
    kinematics, model = listener.model.arm, listener.model
    scale = model.scale
    detector = ContactDetector(model, 1.0, frame.point)
    prior = prior_of(arm.records, listener.channel, scale)
    none = np.zeros_like(prior.joints)
    links = arm.nominal.copy()
    own = base_parameters(kinematics, links[:, 0], links[:, 1:4])
    links[:, 1:3] += (np.array(arm.records.gravity.beta) - own).reshape(-1, 2)
    plain = {"nominal": (arm.nominal, none), "calibrated": (links, prior.joints)}
    left = {}
    for name, (links, joints) in plain.items():
        base, own = (plain_left(kinematics, links, joints, listener, each) for each in (baseline, quiet))
        middle, spread = base.mean(axis=0), base.std(axis=0)
        limit = threshold(block_maxima((np.abs(base - middle) / spread).max(axis=1)), 1.0, kinematics.n)
        left[name] = (-(own - middle), spread, limit)
    slow = slow_before(heard.judged.external)
    lasting, sudden = (np.linalg.inv(each.correlation) for each in (model.lasting, model.sudden))
    sizes = np.geomspace(0.1, 3000.0, 120)
    wanted = {name: [] for name in ("ours", *plain)}
    for push, _ in pushes:
        unit = Push(push.begin, push.end, push.link, push.point, push.force / np.linalg.norm(push.force))
        cut = slice(max(int((push.begin - 0.1) * RATE), 0), int((push.begin + FOUND_WITHIN + 0.2) * RATE))
        short = Motion(work.t[cut], work.q[cut], work.v[cut], work.a[cut], work.moving[cut])
        share = 1.0 - np.exp(-BANDWIDTH / RATE)
        response = lfilter([share], [1.0, share - 1.0], arm.motion.pushed(short, [unit]), axis=0)
        rows = np.flatnonzero((heard.t >= push.begin) & (heard.t <= push.begin + FOUND_WITHIN))
        if not len(rows):
            continue
        pull = np.stack([np.interp(heard.t[rows], short.t, column) for column in response.T], axis=1)
        before = slow[rows[0]]
        external, std, change_std = (
            x[rows] for x in (heard.judged.external, heard.judged.std, heard.judged.change_std)
        )
        a = (external[None] + sizes[:, None, None] * pull) / std
        b = (external[None] - before + sizes[:, None, None] * pull) / change_std
        over = np.einsum("fsi,ij,fsj->fs", a, lasting, a) > detector.lasting_limit
        over |= np.einsum("fsi,ij,fsj->fs", b, sudden, b) > detector.sudden_limit
        wanted["ours"].append(smallest(sizes, over.any(axis=1)))
        for name, (own, spread, limit) in left.items():
            x = np.abs(own[rows][None] + sizes[:, None, None] * pull) / spread
            wanted[name].append(smallest(sizes, (x.max(axis=2) > limit).any(axis=1)))
    return {name: float(np.quantile(each, 0.95)) for name, each in wanted.items()}


def smallest(sizes, over) -> float:
    """From which on all sizes are found."""
    missed = np.flatnonzero(~over)
    return float(sizes[min(missed[-1] + 1, len(sizes) - 1)]) if len(missed) else float(sizes[0])


def slow_before(external):
    from gcomp.external.external_model import slow_mean

    return slow_mean(external)


def plain_left(kinematics, links, joints, listener, recording):
    """Residual of a momentum observer (S, n) [N·m]."""
    from gcomp.external.external_model import stride_of

    parts = []
    for _, samples in listener.samples(recording):
        made = RowFilter(kinematics, links, listener.rate, stride_of(listener.rate))
        for begin in range(0, len(samples), CHUNK):
            filtered = made.rows(samples.part(slice(begin, begin + CHUNK)), derivatives=False)
            left = filtered.torque - filtered.links - (filtered.joints * joints).sum(-1)
            parts.append(left[filtered.chosen])
    return np.concatenate(parts)


def main() -> int:
    """Run, tell, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--only", nargs="+", choices=["link", "motor"], default=["link", "motor"])
    given = parser.parse_args()
    every: dict[str, list[Outcome]] = {}
    for seed in range(given.first, given.first + given.draws):
        makers = [lambda s=seed, level=level: link_arm(s, level) for level in LEVELS] if "link" in given.only else []
        makers += [lambda s=seed: motor_arm(s)] if "motor" in given.only else []
        for make in makers:
            began = time.monotonic()
            arm = make()
            one = judge(arm, 60.0 * given.minutes)
            every.setdefault(arm.name, []).append(one)
            print(f"{seed:>3} {arm.name}: {told([one])} ({time.monotonic() - began:.0f} s)", flush=True)
    wrong = []
    for name, outcomes in every.items():
        print(f"{name}, {len(outcomes)} arms: {told(outcomes)}")
        wrong += failed(name, outcomes)
    return exit_status(wrong)


def shares(outcomes: list[Outcome]) -> tuple[float, float]:
    """Of rows within their bounds; arms have different numbers of joints."""
    return tuple(float(np.mean(np.concatenate([getattr(o, k).ravel() for o in outcomes]))) for k in ("rest", "moving"))


def told(outcomes: list[Outcome]) -> str:
    rest, moving = shares(outcomes)
    pushed, found, right, loads, loads_told, contacts, false = (
        sum(getattr(o, k) for o in outcomes)
        for k in ("pushed", "found", "right", "loads", "loads_told", "load_contacts", "false")
    )
    hours = sum(o.hours for o in outcomes)
    needed = {k: float(np.median([o.needed[k] for o in outcomes])) for k in outcomes[0].needed}
    return (
        f"bounds hold {rest:.1%} at rest, {moving:.1%} in motion; {false} false alarms in {hours:.2f} h; pushes found "
        f"{found}/{pushed}, link or neighbour {right}/{found}; loads told {loads_told}/{loads}, called contact "
        f"{contacts}; force found in 95 %: " + ", ".join(f"{k} {v:.1f} N" for k, v in needed.items())
    )


def failed(name: str, outcomes: list[Outcome]) -> list[str]:
    rest, moving = shares(outcomes)
    wrong = [f"{name}: bounds at rest {rest:.1%}"] * (not COVERAGE[0] <= rest <= COVERAGE[1])
    wrong += [f"{name}: bounds in motion {moving:.1%}"] * (not COVERAGE[0] <= moving <= COVERAGE[1])
    pushed, found, right, contacts, false = (
        sum(getattr(o, k) for o in outcomes) for k in ("pushed", "found", "right", "load_contacts", "false")
    )
    hours = sum(o.hours for o in outcomes)
    wrong += [f"{name}: {false} false alarms in {hours:.1f} h"] * (false > max(1.0, hours))
    wrong += [f"{name}: {found} of {pushed} pushes found"] * bool(found < FOUND * pushed)
    wrong += [f"{name}: {right} of {found} on the right link"] * bool(right < RIGHT_LINK * found)
    wrong += [f"{name}: {contacts} loads called contact"] * (contacts > 0)
    for other in ("nominal", "calibrated"):
        ratio = float(np.median([o.needed["ours"] / o.needed[other] for o in outcomes]))
        wrong += [f"{name}: {ratio:.0%} of the force that {other} needs"] * (ratio > HALF)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
