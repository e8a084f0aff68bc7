"""Where the model's own controller is right, what is wrong besides is found, and not another gain in its place."""

from collections.abc import Collection
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from armlink.recording.recording import Recording
from sim_gap.model.load import load_model
from sim_gap.position_gap import controller, judge
from sim_gap.position_gap.controller import nominal_controller, nominal_point, scales_of, starting_fit
from sim_gap.position_gap.fit import LoopFit, batch, improve
from sim_gap.position_gap.judge import _ordered
from sim_gap.position_gap.parameters import EFFECTS
from sim_gap.position_gap.search import LoopSearch, level_of, with_effect
from sim_gap.position_gap.selection import select_about
from sim_gap.position_gap.simulate import simulate
from sim_gap.position_gap.windows import windows_of

GAIN, LATE_ROWS, LIMIT, INTEGRAL = 40.0, 2, 0.4, 50.0
WEIGHTLESS = model_text(kp=GAIN, friction=0.0, damping=3.0).replace("<option ", '<option gravity="0 0 0" ')
LOOKED_FOR = {"controller.stiffness", "controller.delay", "friction.viscous", "friction.coulomb"}


def started(
    text: str, recording: Recording, more: Collection[str] = (), withheld: Collection[str] = ()
) -> tuple[LoopSearch, LoopFit]:
    """The search on one recording, and the fit that it starts with."""
    sim = load_model(mujoco.MjModel.from_xml_string(text), recording.names, recording.n)
    data = windows_of(sim.arm, [recording], ["r.csv"])
    own = nominal_controller(sim)
    floor = np.full(recording.n, 2e-4)
    never = set(EFFECTS) - LOOKED_FOR - {*more} | {*withheld}
    search = LoopSearch(data, scales_of(data), nominal_point(data, own), floor, frozenset(never))
    search, fit, _ = starting_fit(search, own, lambda text: None)
    return search, fit


@pytest.mark.long
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
    nominal = LoopFit(search.nominal, ((), ()))
    assert level_of(search, nominal, "limit")[0] == pytest.approx(0.35, rel=0.2)
    assert with_effect(search, nominal, "actuator.saturation", 0).point["limit"][0] < 0.6


def test_what_is_withheld_is_as_in_the_model_from_the_start() -> None:
    """A check without the true effect would find it all the same."""
    for effect, name in (("controller.stiffness", "kp"), ("friction.coulomb", "coulomb")):
        real = model_text(kp=0.7 * GAIN, friction=0.2, damping=3.0)
        search, fit = started(WEIGHTLESS, record(real, 2, 14.0), withheld={effect})
        assert (fit.point[name] == search.nominal[name]).all()
        assert all(name not in own for own in fit.active)


def test_an_integral_part_is_tried_at_the_level_that_fits() -> None:
    """A small one only holds the torque at the start: from there no slope leads to one that counts."""
    search, _ = started(WEIGHTLESS, record(WEIGHTLESS, 2, 14.0), {"controller.integral"})
    nominal = LoopFit(search.nominal, ((), ()))
    moved = simulate(search.data, batch([{**search.nominal, "ki": np.full(2, INTEGRAL)}]))[0]
    search = replace(search, data=replace(search.data, measured=moved))
    assert (np.abs(np.log(level_of(search, nominal, "ki") / INTEGRAL)) < np.log(2.5)).all()
    found = improve(search.data, with_effect(search, nominal, "controller.integral", 0), search.scales)
    assert found.point["ki"][0] == pytest.approx(INTEGRAL, rel=0.02)
    assert found.point["ki"][1] == 0.0


def test_the_damping_of_a_servo_that_is_not_known_ends_at_its_limit(monkeypatch) -> None:
    """Without the damping a joint at its limit runs away from its command, and no level of the limit fits."""
    monkeypatch.setattr(controller, "KINDS", {"P": ("delay",)})
    servo = f'<position kv="3" forcerange="-{LIMIT} {LIMIT}" name="shoulder"'
    real = model_text(kp=GAIN, friction=0.0, damping=0.0).replace("<option ", '<option gravity="0 0 0" ')
    text = real.replace('<position name="elbow"', '<position kv="3" name="elbow"')
    text = text.replace('<position name="shoulder"', servo)
    nothing_known = real[: real.index("<actuator>")] + "</mujoco>"
    search, fit = started(nothing_known, record(text, 3, 14.0), {"actuator.saturation"})
    found = select_about(search, fit)
    assert found.point["limit"][0] == pytest.approx(LIMIT, rel=0.15)
    assert np.isinf(found.point["limit"][1])


def test_an_effect_is_weighed_again_once_what_it_needs_is_there() -> None:
    """Stribeck friction is worth nothing without Coulomb friction, and more than what is wrong with joint 2 with it."""
    search = SimpleNamespace(data=SimpleNamespace(weight=np.ones((1, 2, 1))))
    groups = [("friction.stribeck", (0,)), ("friction.coulomb", (0,)), ("friction.viscous", (1,))]

    def with_only(some):
        chosen = {effect for effect, _ in some}
        dry = 1.0 if "friction.coulomb" not in chosen else 0.2 if "friction.stribeck" in chosen else 0.5
        return SimpleNamespace(rms=np.array([[dry], [0.1 if "friction.viscous" in chosen else 0.2]]))

    order = [group[0] for group, _ in _ordered(search, groups, with_only, with_only([]), np.ones(2))]
    assert order == ["friction.coulomb", "friction.stribeck", "friction.viscous"]


def test_what_no_recording_shows_at_a_stiff_joint_comes_after_what_matters(monkeypatch) -> None:
    """Joint 1 follows its command a little too late, by half of what matters there; joint 2 has a larger gap."""
    gaps = {("controller.delay", (0,)): (8e-4, 0.0), ("link.mass_moment", (1,)): (0.0, 4e-3)}
    everything = SimpleNamespace(groups=(*gaps,), rms=np.full((2, 1), 1e-4))

    def taken_out(search, fit, group):
        gap = np.array([gaps[group]]).T
        return SimpleNamespace(groups=tuple(g for g in fit.groups if g != group), rms=fit.rms + gap)

    monkeypatch.setattr(judge, "without_group", taken_out)
    monkeypatch.setattr(judge, "groups_of", lambda fit, search: [*gaps])
    monkeypatch.setattr(judge, "improve", lambda data, fit, scales, iterations: fit)
    monkeypatch.setattr(judge, "_rms", lambda data, fit: fit.rms)
    monkeypatch.setattr(judge, "rivals_of", lambda *given: (9.0, ()))
    data = SimpleNamespace(weight=np.ones((1, 2, 1)))
    search = SimpleNamespace(data=data, scales=None, floor=np.full(2, 1e-5), open_controller=False)
    found = judge.stages(search, everything, data, np.array([1.6e-3, 1.6e-3]))
    assert [stage.group[0] for stage in found] == ["link.mass_moment", "controller.delay"]
