"""How far parameters go from one recording to the next is part of what is not known of them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from sim_gap.closed_loop.controller import nominal_controller, nominal_point, scales_of
from sim_gap.closed_loop.fit import Fit, improve
from sim_gap.closed_loop.judge import covariance, interval
from sim_gap.closed_loop.search import Search
from sim_gap.closed_loop.training.left_out import LeftOut, between_recordings, gaps_left_out, left_out
from sim_gap.closed_loop.windows import windows_of
from sim_gap.model.load import load_model

FRICTION = 0.15, 0.35
FOUND = ("kp", "coulomb", "viscous")


def fitted(*friction: float) -> tuple[Search, Fit]:
    """A fit of one recording of the arm with each friction."""
    sim = load_model(mujoco.MjModel.from_xml_string(model_text(kp=15.0, friction=0.2)))
    made = [record(model_text(kp=15.0, friction=x), seed, 21.0) for seed, x in enumerate(friction, start=1)]
    data = windows_of(sim.arm, made, [f"run {k}" for k in range(len(made))])
    search = Search(data, scales_of(data), nominal_point(data, nominal_controller(sim)), np.full(2, 3e-4))
    return search, improve(data, Fit(search.nominal, (FOUND, FOUND)), search.scales)


@pytest.fixture(scope="module")
def several() -> tuple[Search, Fit]:
    return fitted(*FRICTION, *FRICTION)


def test_an_interval_holds_what_other_recordings_of_the_arm_show(several) -> None:
    """The arm is warm in half of them: noise within a recording says nothing of that."""
    search, fit = several
    within = covariance(search, fit)
    spread = between_recordings(search, within, left_out(search, fit))
    for joint in (0, 1):
        _, low, high, _ = interval(search, fit, spread, joint, "coulomb")
        assert low < FRICTION[0]
        assert FRICTION[1] < high
        _, own_low, own_high, _ = interval(search, fit, within, joint, "coulomb")
        assert FRICTION[0] < own_low
        assert own_high < FRICTION[1]


def test_recordings_that_agree_leave_the_interval_nearly_as_it_is() -> None:
    search, fit = fitted(0.2, 0.2, 0.2, 0.2)
    within = covariance(search, fit)
    spread = between_recordings(search, within, left_out(search, fit))
    wide, own = (np.sqrt(np.diag(x.matrix)) for x in (spread, within))
    assert (wide < 1.5 * own).all()


def test_of_a_single_recording_thirds_are_left_out_and_nothing_is_added() -> None:
    search, fit = fitted(0.2)
    within, others = covariance(search, fit), left_out(search, fit)
    assert not others.recordings
    assert len(others.fits) == len(set(others.groups.tolist())) > 1
    assert between_recordings(search, within, others) is within
    assert gaps_left_out(search, others).shape == search.data.measured.shape


def test_the_jackknife_is_that_of_the_text_books(several) -> None:
    """Of a mean of G values it is their variance over G; widened by Student's over the normal quantile."""
    search, fit = several
    values = np.array([0.15, 0.35, 0.15, 0.35])
    without = [(values.sum() - x) / 3.0 for x in values]
    point = fit.point["coulomb"]
    fits = tuple(fit.with_values(coulomb=np.array([x, point[1]])) for x in without)
    within = replace(covariance(search, fit), names=[(0, "coulomb")], matrix=np.zeros((1, 1)))
    spread = between_recordings(search, within, LeftOut(search.data.recording, fits, recordings=True))
    scale = float(search.scales.of("coulomb")[0])
    expected = np.sqrt(values.var(ddof=1) / 4.0) * 3.182 / 1.960
    assert np.sqrt(spread.matrix[0, 0]) * scale == pytest.approx(expected, rel=1e-3)
