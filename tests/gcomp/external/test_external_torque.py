"""External torque of an arm that MuJoCo moves: bounds, contacts, loads, wrenches."""

import numpy as np
import pytest
from scipy.signal import lfilter

from gcomp.arm.inertials import inertial_of
from gcomp.arm.load import bar_inertials
from gcomp.external.contact import ContactDetector, threshold
from gcomp.external.external_model import (
    BEGINNING,
    ROWS_RATE,
    factor_of_95,
    from_records,
    model_variance,
    variance_components,
)
from gcomp.external.filtered_rows import BANDWIDTH, STATES, RowFilter, Samples, faded_sums
from gcomp.external.rigid_motion import jacobian, momentum_terms, rigid_motion
from gcomp.external.wrench import smallest_force, wrench
from gcomp.gravity.torque import gravity_torque

from .conftest import RATE, Work

FIRST = round(BEGINNING * ROWS_RATE)
POINT = np.array([0.0, 0.02, 0.1])


def test_a_rigid_arm_s_torque_is_that_of_its_links(placed):
    work = Work(placed, 3, 10.0)
    made = RowFilter(placed.arm.arm, bar_inertials(placed), RATE, 4).rows(work.samples())
    slow = made.joints[..., 0] * 0.1  # the offset's column, filtered as the rest
    left = made.torque - 1.02 * made.links - slow
    assert np.abs(left)[20:].max() < 1.3  # friction alone


def test_rows_do_not_depend_on_how_samples_arrive(placed):
    work = Work(placed, 3, 4.0).samples()
    whole = RowFilter(placed.arm.arm, bar_inertials(placed), RATE, 4).rows(work)
    made = RowFilter(placed.arm.arm, bar_inertials(placed), RATE, 4)
    parts = [made.rows(work.part(slice(begin, begin + 7))) for begin in range(0, len(work), 7)]
    for name in ("torque", "links", "joints", "by_link", "state"):
        assert np.concatenate([getattr(part, name) for part in parts]) == pytest.approx(getattr(whole, name), abs=1e-9)


def test_sums_that_fade_are_those_of_a_recursive_filter():
    values, before = np.random.default_rng(2).normal(size=(100, 3, 2)), np.ones((3, 2))
    wanted, _ = lfilter([1.0], [1.0, -0.9], values, axis=0, zi=0.9 * before[None])
    assert faded_sums(values, 0.9, before) == pytest.approx(wanted, abs=1e-12)


def judged(learned, work, external=0.0):
    rows = learned.rows(learned.filter(RATE).rows(work.samples(external)))
    detector = ContactDetector(learned, 1.0, POINT)
    return *detector.judge(work.t[:: round(RATE / ROWS_RATE)], rows), detector


def test_bounds_hold_in_new_work_and_nothing_touches_the_arm(placed, learned):
    told, events, _ = judged(learned, Work(placed, 5, 60.0))
    within = np.abs(told.external) < 1.96 * told.std
    assert 0.9 < within[FIRST:].mean() < 0.99
    assert events == []


def pushed(work, placed, force, link, begin, end):
    arm = placed.arm.arm
    pull = np.einsum("kdn,d->kn", jacobian(rigid_motion(arm, work.q, work.v), link, POINT)[:, :3], force)
    return pull * ((work.t >= begin) & (work.t < end))[:, None]


def test_a_push_is_a_contact_on_its_link_with_a_lower_bound(placed, learned):
    work, force = Work(placed, 6, 30.0), np.array([6.0, 8.0, -4.0])
    told, events, _ = judged(learned, work, pushed(work, placed, force, 3, 12.0, 13.0))
    assert [event.kind for event in events] == ["contact"]
    assert events[0].t == pytest.approx(12.05, abs=0.15)
    assert events[0].told <= events[0].t + 0.3
    assert events[0].link in (2, 3)
    assert 0.0 < events[0].least_force < np.linalg.norm(force)
    low_passed = lfilter([1 - np.exp(-BANDWIDTH / RATE)], [1, -np.exp(-BANDWIDTH / RATE)],
                         pushed(work, placed, force, 3, 12.0, 13.0), axis=0)[:: round(RATE / ROWS_RATE)]  # fmt: skip
    off = np.abs(told.external - low_passed)[FIRST:] < 1.96 * told.std[FIRST:]
    assert off.mean() > 0.9


def test_what_has_gone_was_a_push_if_it_would_still_show_were_it_a_load(placed, learned):
    """Straight down at the hand, as a load would."""
    work, force = Work(placed, 6, 30.0), np.array([0.3, 0.6, -3.0])
    _, events, _ = judged(learned, work, pushed(work, placed, force, 3, 12.0, 12.7))
    assert [event.kind for event in events] == ["contact or load", "contact"]
    assert events[1].odds > 3.0 > events[0].odds


@pytest.mark.parametrize("seed", [7, 11])
def test_a_load_that_other_poses_hide_does_not_become_a_contact(placed, learned, seed):
    work = Work(placed, seed, 40.0)
    _, events, _ = judged(learned, work, carried(work, placed, 0.15, 15.0))
    assert events
    assert "contact" not in [event.kind for event in events]


def carried(work, placed, mass, begin):
    """Torque (K, n) with which a load from a time on pushes the joints [N·m]."""
    arm = placed.arm.arm
    links = np.zeros((arm.n, 10))
    links[-1] = inertial_of(mass, POINT, np.zeros((3, 3)))
    step = 1e-5
    after, before = (
        momentum_terms(rigid_motion(arm, work.q + h * work.v + h * h / 2 * work.a, work.v + h * work.a), links)[0]
        for h in (step, -step)
    )
    torque = (after - before) / (2 * step) - momentum_terms(rigid_motion(arm, work.q, work.v), links)[1]
    return -torque * (work.t >= begin)[:, None]


def test_a_load_taken_up_is_no_contact_and_is_carried_on(placed, learned):
    work, mass = Work(placed, 7, 40.0), 0.8
    _, events, detector = judged(learned, work, carried(work, placed, mass, 15.0))
    assert "contact" not in [event.kind for event in events]
    assert events
    assert events[-1].kind == "load"
    assert detector.load[0] == pytest.approx(mass, rel=0.3)


def test_a_wrench_is_told_only_along_directions_that_the_joints_show(placed):
    arm, work = placed.arm.arm, Work(placed, 8, 1.0)
    motion = rigid_motion(arm, work.q, work.v)
    force = np.array([3.0, -2.0, 5.0])
    external = np.einsum("kdn,d->kn", jacobian(motion, 3, POINT)[:, :3], force)
    told = wrench(motion, 3, POINT, external, np.full(external.shape, 0.1), np.eye(4))
    assert not told.determined.all(axis=1).any()  # four joints show four of six directions
    assert told.force == pytest.approx(np.tile(force, (len(external), 1)), abs=1e-6)
    first = wrench(motion, 0, POINT, external, np.full(external.shape, 0.1), np.eye(4))
    assert np.isnan(first.force).any(axis=1).all()  # a joint alone


def test_more_noise_hides_stronger_forces(placed, learned):
    work = Work(placed, 8, 1.0)
    motion = rigid_motion(placed.arm.arm, work.q, work.v)
    quiet, loud = (
        smallest_force(learned, 30.0, motion, 3, POINT, np.full(work.q.shape, std), learned.sudden)[0]
        for std in (0.1, 0.3)
    )
    assert loud == pytest.approx(3 * quiet)


def test_the_records_alone_bound_gravity_by_their_covariance(placed, prior):
    arm = placed.arm.arm
    model = from_records(arm, prior, np.full(arm.n, 10.0))
    work = Work(placed, 9, 2.0)
    rows = model.rows(model.filter(RATE).rows(work.samples()))
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(2 * arm.n), prior.covariance[:8, :8], 200)
    q = work.q[:: round(RATE / ROWS_RATE)][-1]
    spread = np.std([gravity_torque(arm, beta, q) for beta in drawn], axis=0)
    assert (model_variance(rows.columns, model.factors)[-1] > 0.7 * spread**2).all()


def test_variance_components_are_those_that_the_rows_were_drawn_with():
    random = np.random.default_rng(4)
    parts = np.column_stack([np.ones(20_000), random.uniform(0, 1, 20_000) < 0.3, random.exponential(1, 20_000)])
    square = (parts @ [0.5, 4.0, 1.0]) * random.normal(size=20_000) ** 2
    assert variance_components(parts, square) == pytest.approx([0.5, 4.0, 1.0], rel=0.15)


def test_rows_of_one_rest_are_one_value_when_bounds_are_set():
    random, held = np.random.default_rng(6), []
    for _ in range(400):
        rests = np.repeat(random.uniform(-1.0, 1.0, 30), 40) + 1e-3 * random.normal(size=1200)
        ones = np.ones(1200)
        held.append(min(1.96 * factor_of_95(rests, ones, 0.0 * ones), 1.0))  # as a new rest is uniform, too
    assert 0.945 < np.mean(held) < 0.975  # of 30 values the 29th would not be enough


def test_friction_of_a_joint_at_rest_grows_with_the_torque_it_holds(placed):
    pose, n = np.array([0.3, -0.5, 0.8, 0.2]), placed.arm.arm.n
    q = np.vstack([np.linspace(pose - 0.5, pose, 100), np.tile(pose, (100, 1))])
    samples = Samples(q, np.gradient(q, 1 / RATE, axis=0), 0.0 * q, 0.0 * q)
    state = RowFilter(placed.arm.arm, bar_inertials(placed), RATE).rows(samples).state[..., STATES.index("held")]
    gravity = np.abs(gravity_torque(placed.arm.arm, placed.arm.beta, pose))
    assert (state[50] < 0.1 * gravity + 1e-9).all()
    assert state[-1] == pytest.approx(gravity, rel=1e-3)
    assert state.shape == (200, n)


def test_a_threshold_is_exceeded_as_often_as_it_says():
    random = np.random.default_rng(5)
    maxima = random.chisquare(4, (900, 50)).max(axis=1)  # half an hour of stretches of 2 s
    limit = threshold(maxima, 6.0, 4)
    new = random.chisquare(4, (18_000, 50)).max(axis=1)  # ten hours
    assert 20 < (new > limit).sum() < 180
    assert threshold(np.empty(0), 1.0, 4) == pytest.approx(28.2, abs=0.1)
