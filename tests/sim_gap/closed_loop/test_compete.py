"""Where the model's own controller is right, what is wrong besides is found, and not another gain in its place."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from armlink.recording.recording import Recording
from sim_gap.closed_loop.compete import select_about
from sim_gap.closed_loop.controller import nominal_controller, nominal_point, scales_of, starting_fit
from sim_gap.closed_loop.fit import Fit
from sim_gap.closed_loop.parameters import EFFECTS
from sim_gap.closed_loop.search import Search, level_of, with_effect
from sim_gap.closed_loop.windows import windows_of
from sim_gap.model.load import load_model

GAIN, LATE_ROWS = 40.0, 2
WEIGHTLESS = model_text(kp=GAIN, friction=0.0, damping=3.0).replace("<option ", '<option gravity="0 0 0" ')
LOOKED_FOR = {"controller.stiffness", "controller.delay", "friction.viscous", "friction.coulomb"}


def started(text: str, recording: Recording) -> tuple[Search, Fit]:
    """The search on one recording, and the fit that it starts with."""
    sim = load_model(mujoco.MjModel.from_xml_string(text), recording.names, recording.n)
    data = windows_of(sim.arm, [recording], ["r.csv"])
    own = nominal_controller(sim)
    floor = np.full(recording.n, 2e-4)
    search = Search(data, scales_of(data), nominal_point(data, own), floor, frozenset(set(EFFECTS) - LOOKED_FOR))
    search, fit, _ = starting_fit(search, own, lambda text: None)
    return search, fit


def test_a_delay_is_not_told_as_another_gain() -> None:
    """Without gravity a lower gain with its damping follows as late as a delayed one."""
    seen = record(WEIGHTLESS, 1, 14.0)
    early = np.vstack([seen.position_command[LATE_ROWS:], np.repeat(seen.position_command[-1:], LATE_ROWS, axis=0)])
    search, fit = started(WEIGHTLESS, replace(seen, position_command=early))
    found = select_about(search, fit)
    for own, kp, delay in zip(found.active, found.point["kp"], found.point["delay"], strict=True):
        assert "delay" in own
        assert delay == pytest.approx(LATE_ROWS / 50.0, abs=0.006)
        assert kp == pytest.approx(GAIN, rel=0.05)


def test_a_limit_is_tried_at_the_level_that_fits() -> None:
    """The model has one that is never reached, from which no slope leads to the true one."""
    real = WEIGHTLESS.replace('<position name="shoulder"', '<position forcerange="-0.35 0.35" name="shoulder"')
    known = WEIGHTLESS.replace('<position name="shoulder"', '<position forcerange="-50 50" name="shoulder"')
    search, _ = started(known, record(real, 2, 14.0))
    nominal = Fit(search.nominal, ((), ()))
    assert 0.2 < level_of(search, nominal, "limit")[0] < 0.6
    assert with_effect(search, nominal, "actuator.saturation", 0).point["limit"][0] < 0.6
