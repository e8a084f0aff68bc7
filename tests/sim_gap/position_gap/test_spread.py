"""What recordings leave open: from one to the next, and along the scale that a position does not show."""

from dataclasses import replace

import numpy as np
import pytest
from servo_arm import JOINTS, at_both, fitted

from sim_gap.position_gap import sound_arm
from sim_gap.position_gap.fit import LoopFit, LoopSearch, residuals
from sim_gap.position_gap.training import spread
from sim_gap.position_gap.training.spread import (
    Covariance,
    WindowTerms,
    covariance,
    covariance_within,
    draw,
    interval,
    jackknifed,
    terms_of,
)
from sim_gap.search.estimate import NOMINAL

FRICTION = 0.15, 0.35


@pytest.fixture(scope="module")
def several() -> tuple[LoopSearch, LoopFit]:
    return fitted(*FRICTION, *FRICTION)


@pytest.fixture(scope="module")
def weightless() -> tuple[LoopSearch, LoopFit]:
    return fitted(0.2, 0.2, weightless=True)


def within(search: LoopSearch, fit: LoopFit) -> Covariance:
    return covariance_within(search, fit, terms_of(search, fit))


def deviations(found: Covariance, name: str) -> np.ndarray:
    return np.array([np.sqrt(found.matrix[k, k]) for k in (found.names.index((j, name)) for j in (0, 1))])


@pytest.mark.long
def test_an_interval_holds_what_other_recordings_of_the_arm_show(several) -> None:
    """The arm is warm in half of them: noise within a recording says nothing of that."""
    search, fit = several
    for joint in (0, 1):
        found = interval(search, fit, covariance(search, fit), joint, "coulomb")
        assert found.low < FRICTION[0]
        assert FRICTION[1] < found.high
        own = interval(search, fit, within(search, fit), joint, "coulomb")
        assert FRICTION[0] < own.low
        assert own.high < FRICTION[1]


@pytest.mark.long
def test_recordings_that_agree_leave_the_interval_nearly_as_it_is() -> None:
    search, fit = fitted(0.2, 0.2, 0.2, 0.2)
    wide, own = covariance(search, fit), within(search, fit)
    for name in ("kp", "viscous"):
        assert (deviations(wide, name) < 2.0 * deviations(own, name)).all()


def test_the_jackknife_is_that_of_the_text_books() -> None:
    """Of a mean of G values it is their variance over G."""
    values = np.array([0.15, 0.35, 0.2, 0.5])
    terms = WindowTerms([(0, "coulomb")], np.ones((4, 1, 1)), (0.3 - values)[:, None], np.zeros(0), [])
    found = jackknifed(terms, np.zeros(1), np.arange(4))
    assert found[0, 0] == pytest.approx(values.var(ddof=1) / 4.0)


def test_of_an_arm_that_feels_no_weight_ratios_are_told_better_than_their_scale(weightless, monkeypatch) -> None:
    """Where commands are in time: what is not known of that is not known of the ratio of gain and damping, a time."""
    monkeypatch.setattr(sound_arm, "LATE_S", 1e-6)
    monkeypatch.setattr(sound_arm, "APART_S", 1e-6)
    search, fit = weightless
    found = covariance(search, fit)
    for j in (0, 1):
        gain, damping = (found.names.index((j, name)) for name in ("kp", "viscous"))
        ratio = np.zeros(len(found.names))
        ratio[gain], ratio[damping] = 1.0, -search.scales.of("viscous")[j] / fit.point["viscous"][j]
        told, own = ratio @ found.matrix @ ratio, found.matrix[gain, gain]
        assert told - 2.0 * spread.SYSTEMATIC**2 < 0.25 * (own - spread.SYSTEMATIC**2)


def test_a_gain_that_may_be_half_as_large_again_has_no_scale(weightless) -> None:
    _, fit = weightless
    found = Covariance([(0, "kp"), (1, "kp")], np.diag([0.5**2, 0.2**2]))
    assert spread.undecided_scale(fit, found) == [0]


def test_draws_of_an_undecided_scale_move_the_arm_as_the_fit_does(weightless) -> None:
    search, fit = weightless
    names = ("kp", "coulomb", "viscous", "armature")
    scaled = [1.0, *(fit.point[name][1] / search.scales.of(name)[1] for name in names[1:])]
    found = Covariance([(1, name) for name in names], 0.4**2 * np.outer(scaled, scaled))
    rows = draw(search, fit, found, 40)
    gains = np.array([row["elbow.kp"] for row in rows])
    assert gains.max() > 2.0 * gains.min()
    points = []
    for row in rows:
        own = {
            name: np.array([row.get(f"{joint}.{name}", fit.point[name][j]) for j, joint in enumerate(JOINTS)])
            for name in ("kp", "coulomb", "viscous", "armature")
        }
        points.append({**fit.point, **own})
    gaps = residuals(search.data, [fit.point, *points])
    moved = np.sqrt(np.mean((gaps[1:] - gaps[0]) ** 2, axis=(1, 2, 3)))
    assert np.median(moved) < 0.001


def test_no_draw_moves_the_arm_further_than_it_may(several) -> None:
    """A delay known to 0.1 s at one joint alone: draws of it are shortened, and those of the other joint are not."""
    search, fit = several
    found = Covariance([(0, "delay"), (1, "kp")], np.diag([(0.1 / search.scales.of("delay")[0]) ** 2, 0.05**2]))
    free, near = (draw(search, fit, found, 12, reach=reach) for reach in (None, np.array([0.01, 1.0])))

    def moved(rows: list[dict[str, float]]) -> np.ndarray:
        points = [{**fit.point, "delay": np.array([row["shoulder.delay"], fit.point["delay"][1]])} for row in rows]
        gaps = residuals(search.data, [fit.point, *points])[:, :, 0]
        return np.sqrt(np.mean((gaps[1:] - gaps[0]) ** 2, axis=(1, 2)))

    assert np.median(moved(free)) > 0.02
    assert moved(near).max() < 0.0105
    assert np.std([row["shoulder.delay"] for row in near]) > 0.005
    assert [row["elbow.kp"] for row in near] == [row["elbow.kp"] for row in free]
    for one, other, far in zip(near, free, moved(free), strict=True):
        assert one == other if far < 0.0095 else one != other


def test_a_value_that_the_model_states_is_open_where_a_gain_rests_on_it(weightless) -> None:
    """Without damping among the effects its value sets the gain's scale, and no recording has measured it."""
    search, fit = weightless
    some = fit.freed(at_both("kp", "coulomb"))
    found = covariance(search, some)
    assert (0, "viscous") in found.names
    assert (deviations(found, "kp") > 3.0 * deviations(within(search, some), "kp")).all()


def test_of_a_payload_the_centre_is_told_and_not_the_moment() -> None:
    """Of 0.4 ± 0.02 kg and 0.08 ± 0.002 kg·m independent of it: 0.2 m, and relative deviations add in squares."""
    fit = LoopFit({"payload.mass": np.array([0.4]), "payload.x": np.array([0.08])})
    found = Covariance([(-1, "payload.mass"), (-1, "payload.x")], np.diag([0.02**2, 0.002**2]))
    centre = spread.payload_centre(fit, found, "payload.x")
    assert (centre.value, centre.unit) == (pytest.approx(0.2), "m")
    assert centre.high - centre.value == pytest.approx(centre.value - centre.low)
    assert centre.high - centre.value == pytest.approx(2.0 * 0.2 * np.hypot(0.05, 0.025))


def test_a_payload_is_no_surer_than_the_masses_of_the_model(several) -> None:
    """An error of a per cent of the last link's own moment acts as a payload's does."""
    search, fit = several
    names = ("payload.mass", "payload.x", "payload.z")
    point = {**fit.point, **{name: np.zeros(2) for name in names}}
    found = covariance(search, replace(fit, point=point).freed([*fit.free, *((-1, name) for name in names)]))
    assert [name for j, name in found.names if j < 0] == list(names)
    own = float(np.linalg.norm(search.data.plant.sim.arm.inertial[-1, 1:4]))
    at = found.names.index((-1, "payload.x"))
    assert np.sqrt(found.matrix[at, at]) > 0.9 * NOMINAL * own


def test_what_a_sound_arm_may_have_beside_an_effect_widens_its_interval(several) -> None:
    """Friction alone is fitted to an arm whose gain is 3 % off: what the gain takes up is open."""
    search, fit = several
    some = search.improve(fit.with_values(kp=1.03 * fit.point["kp"]).freed(at_both("coulomb")))
    for joint in (0, 1):
        wide, own = covariance(search, some), within(search, some)
        assert deviations(wide, "coulomb")[joint] > deviations(own, "coulomb")[joint]
        found = interval(search, some, wide, joint, "coulomb")
        assert found.low < float(fit.point["coulomb"][joint]) < found.high
