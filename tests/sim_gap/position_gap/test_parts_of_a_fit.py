"""Single steps of the fit of commanded and measured positions, each against a figure of its own."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from servo_arm import at_both, model_text, record, search_on

from armlink.recording.recording import Recording
from gcomp.arm.inertials import body_parameters, set_body
from sim_gap.position_gap import choice as edits
from sim_gap.position_gap import fit as fitting
from sim_gap.position_gap.choice import best_level, look_about, select
from sim_gap.position_gap.fit import LoopFit, jacobian, residuals, rms_on
from sim_gap.position_gap.identify import _frozen
from sim_gap.position_gap.parameters import PARAMETERS, Scales, from_coordinate, to_coordinate
from sim_gap.position_gap.training import export, position_files, spread
from sim_gap.position_gap.training import replay as replays
from sim_gap.position_gap.windows import choose_windows, thin

TEXT = model_text(kp=15.0, friction=0.2)


@pytest.mark.parametrize(
    ("gravity", "off", "frozen"),
    [
        (9.81, True, set()),
        (9.81, False, {"actuator.back_emf"}),
        (0.0, True, {"base.tilt", "position.offset"}),
        (0.0, False, {"base.tilt", "position.offset", "actuator.back_emf"}),
    ],
)
def test_what_nothing_can_show_is_left_out(gravity: float, off: bool, frozen: set[str]) -> None:
    sim = SimpleNamespace(arm=SimpleNamespace(gravity=np.array([0.0, 0.0, -gravity])))
    served = np.ones((5, 2, 1))
    served[3, 1] = 0.0 if off else 1.0
    assert _frozen(sim, SimpleNamespace(served=served)) == frozen


def test_an_effect_of_the_whole_arm_is_taken_out_by_its_own_names(monkeypatch) -> None:
    monkeypatch.setattr(fitting, "shared_effects", lambda arm: {"base.tilt": ("tilt.x", "tilt.y"), "other": ("z",)})
    names = ("tilt.x", "tilt.y", "z")
    fit = LoopFit({name: np.array([0.3]) for name in (*names, "kp")}, tuple((-1, name) for name in names))
    arm = SimpleNamespace(plant=SimpleNamespace(sim=SimpleNamespace(arm=None)))
    bare = edits.without_groups(fitting.LoopSearch(arm, None, {}, np.zeros(1)), fit, ("base.tilt", ()))
    assert {name: float(x[0]) for name, x in bare.point.items()} == {"z": 0.3, "kp": 0.3}
    assert bare.free == ((-1, "z"),)


def test_of_one_motion_what_is_left_of_the_way_to_the_command_is_what_another_may_show(monkeypatch) -> None:
    """A twentieth of it at the first joint, nothing at the second, half at the third, of which no more is unknown than
    of what a model states; nothing where several recordings show it."""
    monkeypatch.setattr(spread, "rms_on", lambda data, point: np.array([0.001, 0.0, 0.01]))
    fit = LoopFit({"kp": np.array([15.0, 10.0, 5.0]), "coulomb": np.array([0.3, 0.2, 0.1])})
    torque, one = np.full(3, 0.5), np.ones(3)
    scales = Scales(torque, torque, one, one, np.full(3, 0.02))
    search = SimpleNamespace(data=SimpleNamespace(of_one_recording=True, joints=3), scales=scales)
    share = 0.05 * spread.OTHERWISE
    found = spread._of_one_motion(search, fit, [(0, "kp"), (0, "coulomb"), (1, "kp"), (2, "kp")])
    coulomb = share * 0.3 / scales.of("coulomb")[0]
    np.testing.assert_allclose(found, [share**2, coulomb**2, 0.0, spread.STATED**2])
    two = SimpleNamespace(data=SimpleNamespace(of_one_recording=False), scales=scales)
    assert not spread._of_one_motion(two, fit, [(0, "kp")]).any()


@pytest.mark.parametrize(("late", "steps"), [(0.4, 0.0), (2.6, 3.0), (-1.0, 0.0)])
def test_delays_are_told_in_whole_steps(monkeypatch, late: float, steps: float) -> None:
    names = ("kp", "gain", "kv", "viscous", "back_emf", "armature", "coulomb", "limit")
    point = {name: np.ones(1) for name in names}
    found = SimpleNamespace(native=SimpleNamespace(point=point), sim=SimpleNamespace(n=1))
    monkeypatch.setattr(position_files, "_delays", lambda found, j, drawn: 0.002 * np.array([late, late]))
    entry = position_files._entry(found, 0, 0.002, [])
    assert (entry["least"], entry["most"]) == (steps, steps)


def test_a_body_gets_the_inertial_parameters_that_it_is_said_to_have() -> None:
    """Half a kilogram at the elbow's axis: mass and first moment of the fore arm, as MuJoCo compiles it."""
    after = mujoco.MjModel.from_xml_string(TEXT)
    change = np.array([0.5, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.005, 0.0, 0.005])  # a point mass at (0.1, 0, 0)
    assert set_body(after, 2, after.jnt_pos[1], body_parameters(after, 2, after.jnt_pos[1], np.eye(3)) + change)
    assert after.body_mass[2] == pytest.approx(0.8)
    assert after.body_mass[2] * after.body_ipos[2] == pytest.approx([0.3 * 0.08 + 0.05, 0.0, 0.0], abs=1e-9)
    apart = 0.3 * 0.5 / 0.8 * 0.02**2
    assert sorted(after.body_inertia[2]) == pytest.approx([1e-3, 1e-3 + apart, 1e-3 + apart])


def test_friction_that_a_simulator_cannot_hold_is_added_to_coulombs(monkeypatch) -> None:
    """Breakaway friction, and that of the load in the mean."""
    nothing = np.zeros(1)
    own = {
        "coulomb": 0.2,
        "stribeck": 0.3,
        "load": 0.1,
        "stribeck_velocity": 0.1,
        "viscous": 0.0,
        "kd": 0.0,
        "feed": 0.0,
        "ki": 0.0,
        "slew": np.inf,
        "delay": 0.0,
        "lag": 0.0,
    }
    fit = LoopFit({name: np.array([value]) for name, value in own.items()})
    fit = fit.freed([(0, "coulomb"), (0, "stribeck"), (0, "stribeck_velocity"), (0, "load")])
    plant = SimpleNamespace(compensated=0.0, servo={"lag": nothing}, sim=SimpleNamespace(arm=SimpleNamespace(names=())))
    data = SimpleNamespace(joints=1, torque=np.full((5, 1, 2), 4.0), plant=plant)
    monkeypatch.setattr(export, "compensation", lambda search, fit: None)
    monkeypatch.setattr(fitting.LoopSearch, "improve", lambda search, fit, iterations: fit)
    search = fitting.LoopSearch(data, None, dict.fromkeys(own, nothing), nothing)
    held = export.native_fit(search, fit)
    assert held.point["coulomb"] == pytest.approx([0.2 + 0.3 + 0.4])
    assert held.point["stribeck"] == held.point["load"] == 0.0


def test_the_opening_of_a_replay_is_not_judged(monkeypatch) -> None:
    t = 5.0 + np.arange(0.0, 4.0, 0.1)
    simulated, measured = np.where(t < 5.95, 7.0, 0.5)[:, None], np.zeros((len(t), 1))
    monkeypatch.setattr(replays, "_replay", lambda arm, recording: simulated)
    recording = Recording(t=t, position=measured, position_command=measured)
    assert replays.replay_rms(replays.Simulated(None, (0,)), [recording]) == pytest.approx([0.5])


def test_slopes_are_those_of_the_residual() -> None:
    search = search_on(TEXT, [record(TEXT, 1, 14.0)])
    now, slopes = jacobian(search, search.nominal, at_both("kp", "viscous"))
    change = residuals(search.data, [{**search.nominal, "kp": search.nominal["kp"] * np.exp(0.03)}])[0] - now
    for j in range(2):
        expected = 0.03 * slopes[j][0]
        assert np.linalg.norm(change[:, j] - expected) < 0.2 * np.linalg.norm(expected)


def test_a_parameter_at_its_highest_value_has_a_slope_too() -> None:
    """Else a fit that has come there never leaves, and its interval would be nothing."""
    search = search_on(TEXT, [record(TEXT, 1, 8.0)])
    point = {**search.nominal, "load": np.full(2, PARAMETERS["load"].high)}
    _, slopes = jacobian(search, point, at_both("load"))
    assert all(np.linalg.norm(slope) > 0.0 for slope in slopes)


def test_a_joint_that_moves_in_few_windows_moves_in_one_that_is_fitted() -> None:
    """Of a joint that rests in all of them anything fits: no gain, and any friction."""
    data = search_on(TEXT, [record(TEXT, 1, 14.0)]).data
    count = 40
    many = replace(choose_windows(data, np.zeros(count, int)), recording=np.arange(count))
    still = np.ones(count)
    still[7] = 0.0
    speed = many.v.copy()
    speed[:, 1] *= 0.1 * still + (1.0 - still)
    assert thin(replace(many, v=speed), 4, moving=True).recording.tolist() == [0, 7, 13, 26, 39]
    assert thin(many, 4, moving=True).recording.tolist() == [0, 13, 26, 39]
    assert thin(many, count, moving=True) is many


def test_a_limit_is_tried_at_the_level_that_fits() -> None:
    """From a limit that is never reached no slope leads to the true one."""
    weightless = TEXT.replace("<option ", '<option gravity="0 0 0" ')
    real = weightless.replace('<position name="shoulder"', '<position forcerange="-0.45 0.45" name="shoulder"')
    search = search_on(weightless, [record(real, 2, 14.0)])
    level = best_level(search, LoopFit(search.nominal), "limit")
    assert level[0] == pytest.approx(0.45, rel=0.4)


def test_a_spring_is_found_beside_a_servo_that_is_much_stronger_than_the_links_are_heavy() -> None:
    text = model_text(kp=400.0, friction=0.0, damping=8.0)
    sprung = text.replace('name="shoulder" axis', 'name="shoulder" stiffness="25" axis')
    search = search_on(text, [record(sprung, 2, 14.0)])
    fit = search.improve(LoopFit(search.nominal).freed([(0, "spring"), (0, "offset")]))
    assert fit.point["spring"][0] == pytest.approx(25.0, rel=0.03)
    assert fit.point["offset"][0] == pytest.approx(0.0, abs=0.3)


def test_friction_of_a_model_is_in_doubt_by_its_own_size_where_links_ask_for_little() -> None:
    light = {'mass="0.6"': 'mass="0.006"', 'mass="0.3"': 'mass="0.003"'}
    stated, true = (model_text(kp=15.0, friction=dry, damping=damping) for dry, damping in ((0.3, 3.0), (0.1, 1.0)))
    for old, new in light.items():
        stated, true = stated.replace(old, new), true.replace(old, new)
    search = search_on(stated, [record(true, 2, 14.0)])
    fit = search.improve(LoopFit(search.nominal).freed(at_both("coulomb", "viscous")))
    np.testing.assert_allclose(fit.point["viscous"], 1.0, rtol=0.05)
    np.testing.assert_allclose(fit.point["coulomb"], 0.1, rtol=0.1)


def moved(name: str, value: float, step: float) -> float:
    """A parameter's value after a step in its own coordinate, where all sizes are 1."""
    size = float(Scales(*np.ones((5, 1))).of(name)[0])
    return float(from_coordinate(name, np.array(to_coordinate(name, value, size) + step), np.array(size)))


def test_a_spring_does_not_push_away_from_its_rest() -> None:
    """A negative one fits the range of one recording and nothing beyond."""
    assert moved("spring", 0.1, -50.0) == 0.0
    assert moved("offset", 0.1, -50.0) < 0.0


def test_a_limit_is_fitted_by_its_inverse_and_none_is_nothing() -> None:
    assert moved("limit", 2.0, 0.5) == pytest.approx(1.0)
    assert moved("limit", 2.0, -0.5) == np.inf


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "effects"),
    [
        (lambda text: text.replace('kp="15.0"', 'kp="11.0"', 1), {("controller.stiffness", (0,))}),
        (lambda text: text.replace('damping="0.8"', 'damping="1.4"', 1), {("friction.viscous", (0,))}),
        (
            lambda text: text.replace("<option ", '<option gravity="1.5 0 -9.7" '),
            {("base.tilt", ()), ("position.offset@shoulder", ())},  # the same, of an arm whose joints are parallel
        ),
    ],
    ids=["gain", "damping", "tilt"],
)
def test_what_differs_alone_is_chosen_alone(change, effects: set[fitting.Group]) -> None:
    """From the model as it is, of all effects of joints and arm but those that every joint has, which cost nothing."""
    real = change(TEXT)
    search = search_on(TEXT, [record(real, seed, 14.0) for seed in (1, 2)])
    search = replace(search, excluded=frozenset({"actuator.back_emf"}))  # no servo is ever off
    fit = select(search, LoopFit(search.nominal))
    assert (rms_on(search.data, fit.point) < 1.5e-3).all()
    chosen = {*edits.chosen_of(search, fit)}
    assert len(chosen & effects) == 1
    assert {effect for effect, _ in chosen - effects} <= {*edits.OF_EVERY_JOINT}


def test_what_needs_coulomb_friction_needs_it_where_the_model_has_none() -> None:
    search = search_on(TEXT, [record(TEXT, 1, 8.0)])
    search = replace(search, nominal={**search.nominal, "coulomb": np.array([0.2, 0.0])})
    names = [("friction.asymmetric", (0,)), ("friction.asymmetric", (1,))]
    about = look_about(search, LoopFit(search.nominal), names)
    assert about.effects[names[0]].needs == ()
    assert about.effects[names[1]].needs == (("friction.coulomb", (1,)),)
