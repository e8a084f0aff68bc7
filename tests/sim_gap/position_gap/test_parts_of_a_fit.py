"""Single steps of the fit of commanded and measured positions, each against a figure of its own."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from armlink.recording.recording import Recording
from sim_gap.effects.base import tilt_gravity
from sim_gap.model.load import load_model
from sim_gap.position_gap import judge, rivals, selection
from sim_gap.position_gap import search as edits
from sim_gap.position_gap.columns import shared_effects, with_columns
from sim_gap.position_gap.controller import _from_grid, nominal_controller, nominal_point, scales_of
from sim_gap.position_gap.fit import LoopFit, batch, coordinate, evaluate, improve, jacobian, residuals
from sim_gap.position_gap.identify import _frozen, not_worse
from sim_gap.position_gap.parameters import EFFECTS, PARAMETERS, WITH_TORQUE, Scales, relative_step
from sim_gap.position_gap.search import PRICE, LoopSearch, level_of
from sim_gap.position_gap.selection import _explained, _shared_round, ranked, select
from sim_gap.position_gap.simulate import simulate
from sim_gap.position_gap.tracks import held_command
from sim_gap.position_gap.training import export, jackknife, spread, training_files
from sim_gap.position_gap.training import replay as replays
from sim_gap.position_gap.windows import WARM_S, Windows, choose_windows, thin_moving, windows_of

TEXT = model_text(kp=15.0, friction=0.2)
SMOOTH = model_text(kp=3.0, friction=0.0)


@pytest.fixture(scope="module")
def data() -> Windows:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    return windows_of(sim.arm, [record(TEXT, 1, 14.0)], ["run"])


@pytest.fixture(scope="module")
def search(data: Windows) -> LoopSearch:
    """About the model with its gains unknown."""
    bare = load_model(mujoco.MjModel.from_xml_string(TEXT.partition("<actuator>")[0] + "</mujoco>"))
    point = nominal_point(data, nominal_controller(bare))
    return LoopSearch(data, scales_of(data), point, np.full(2, 1e-4))


def test_the_grid_finds_a_stiffness_near_the_servos(search: LoopSearch) -> None:
    """Its points are a factor of two apart."""
    found = _from_grid(search, ("delay",)).point
    assert np.abs(np.log2(found["kp"] / 15.0)).max() < 1.2
    assert (found["feed"] == 0.0).all()


def test_the_grid_centres_on_the_torque_that_the_error_has_to_make(search: LoopSearch, monkeypatch) -> None:
    """With feed-forward on what that leaves, which is next to nothing of gravity's torque."""
    asked: dict[str, np.ndarray] = {}

    def gaps(data: Windows, values: dict[str, np.ndarray]) -> np.ndarray:
        asked.update(values)
        return np.zeros((len(values["kp"]), 1, 2, 1))

    monkeypatch.setattr("sim_gap.position_gap.controller.residuals", gaps)
    monkeypatch.setattr("sim_gap.position_gap.controller.evaluate", lambda data, fit: fit)
    d = search.data
    error = np.sqrt(np.mean((d.command - d.recorded) ** 2, axis=(0, 2)))
    needed = d.gravity + d.coupling + (d.inertia + d.arm.armature[:, None]) * d.a
    for parts, feed in (((), 0.0), (("feed",), 1.0)):
        point = _from_grid(search, parts).point
        size = np.sqrt(np.mean((needed - feed * d.feed) ** 2, axis=(0, 2))) / error
        centre = np.maximum(size, 25.0 * search.scales.inertia)
        np.testing.assert_allclose(asked["kp"].min(0), 0.02 * centre, rtol=1e-6)
        np.testing.assert_allclose(asked["kp"].max(0), 50.0 * centre, rtol=1e-6)
        assert (point["feed"] == feed).all()


def test_a_parameters_slope_is_that_at_its_value(data: Windows) -> None:
    """Friction of a small joint: a step as large as the joint's own scale would bend it by a tenth; one joint sticks
    once more or less often within the step."""
    one = np.ones(2)
    scales = Scales(one, one, 0.02 * one, 0.05 * one)
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    point = nominal_point(data, nominal_controller(sim))
    fit = LoopFit(point, (("viscous",), ("viscous",)))
    _, slopes = jacobian(data, fit, scales, fit.active)
    for j in range(2):
        ends = []
        for side in (1e-4, -1e-4):
            values = {**point, "viscous": point["viscous"] + side * (np.arange(2) == j)}
            ends.append(simulate(data, batch([values]))[0, :, j] * data.weight[:, j])
        expected = (ends[0] - ends[1]) / 2e-4 * 0.2  # in units of the size at which it is tried
        assert np.linalg.norm(slopes[j][0] - expected) < 0.08 * np.linalg.norm(expected)


def test_a_models_own_pid_and_delay_are_its_controllers() -> None:
    """Behind a gear of 2 at the elbow: torque and speed at the joint; the shoulder has a P servo."""
    spec = mujoco.MjSpec.from_string(TEXT)
    servo = spec.actuator("elbow")
    servo.set_to_pid(kp=3.0, ki=2.0, kv=0.25, slewmax=8.0, ctrlspec=export.POSITION_INPUT)
    servo.gear[0], servo.delay, servo.nsample = 2.0, 0.012, 8
    sim = load_model(spec.compile())
    own = nominal_controller(sim)
    assert own.complete
    shoulder, elbow = np.transpose([own.kp, own.kv, own.ki, own.limit, own.slew, own.delay])
    np.testing.assert_allclose(elbow, [12.0, 1.0, 8.0, np.inf, 4.0, 0.012])
    assert (shoulder[1:] == [0.0, 0.0, np.inf, np.inf, 0.0]).all()
    point = nominal_point(windows_of(sim.arm, [record(TEXT, 1, 8.0)], ["run"]), own)
    assert {name: float(point[name][1]) for name in ("kp", "ki", "slew", "delay", "kv")} == {
        "kp": 12.0,
        "ki": 8.0,
        "slew": 4.0,
        "delay": 0.012,
        "kv": 1.0,
    }


def test_a_joint_whose_command_rests_has_levels_of_a_slew_limit_all_the_same(data: Windows) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    still = data.speed.copy()
    still[:, 1] = 0.0
    point = nominal_point(data, nominal_controller(sim))
    search = LoopSearch(replace(data, speed=still), scales_of(data), point, np.full(2, 3e-4))
    level = level_of(search, LoopFit(point, ((), ())), "slew")
    assert (level >= 0.1 * PARAMETERS["slew"].low).all()
    assert level[0] > 10.0 * level[1]


def test_slopes_add_up_to_that_by_the_common_scale_of_all_torques(data: Windows) -> None:
    """Sticking and slipping roughen each difference: of friction and gain alone they would add up to much more."""
    scales, names = scales_of(data), ("kp", "coulomb", "viscous", "armature", "delay")
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    fit = LoopFit(nominal_point(data, nominal_controller(sim)), (names, names))
    _, slopes = jacobian(data, fit, scales, fit.active)
    scaled = {name: values * (np.exp(0.01) if name in WITH_TORQUE else 1.0) for name, values in fit.point.items()}
    gaps = residuals(data, batch([fit.point, scaled]))
    for j in range(2):
        expected = (gaps[1] - gaps[0])[:, j] / 0.01
        shares = [relative_step(name, fit.point[name][j], scales, j) if name in WITH_TORQUE else 0.0 for name in names]
        np.testing.assert_allclose(np.tensordot(shares, slopes[j], 1), expected, atol=1e-12)


def test_a_parameter_at_its_highest_value_has_a_slope_too(data: Windows) -> None:
    """Else a fit that has come there never leaves, and its interval would be nothing."""
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    one = np.ones(2)
    point = {**nominal_point(data, nominal_controller(sim)), "load": np.full(2, PARAMETERS["load"].high)}
    fit = LoopFit(point, (("load",), ("load",)))
    _, slopes = jacobian(data, fit, Scales(one, one, 0.02 * one, 0.05 * one), fit.active)
    assert all(np.linalg.norm(slope) > 0.0 for slope in slopes)


def test_a_joint_that_moves_in_few_windows_moves_in_one_that_is_fitted(data: Windows) -> None:
    """Of a joint that rests in all of them anything fits: no gain, and any friction."""
    count = 40
    many = replace(choose_windows(data, np.zeros(count, int)), recording=np.arange(count))
    still = np.ones(count)
    still[7] = 0.0
    speed = many.v.copy()
    speed[:, 1] *= 0.1 * still + (1.0 - still)
    chosen = thin_moving(replace(many, v=speed), 4)
    assert chosen.recording.tolist() == [0, 7, 13, 26, 39]
    assert thin_moving(many, 4).recording.tolist() == [0, 13, 26, 39]
    assert thin_moving(many, count) is many


def test_a_joint_that_is_left_worse_than_by_the_model_keeps_the_models_values(data: Windows) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    point = nominal_point(data, nominal_controller(sim))
    search = LoopSearch(data, scales_of(data), point, np.full(2, 3e-4))
    stuck = {**point, "kp": point["kp"] * [1.0, 0.1]}
    fit = not_worse(search, evaluate(data, LoopFit(stuck, (("kp",), ("kp",)))), np.full(2, np.inf))
    np.testing.assert_array_equal(fit.point["kp"], point["kp"])
    assert fit.active == (("kp",), ())
    np.testing.assert_array_equal(fit.rms, evaluate(data, LoopFit(point, ((), ()))).rms)


def test_a_joint_that_mujoco_moves_as_it_was_measured_keeps_the_models_values(data: Windows) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    point = {**nominal_point(data, nominal_controller(sim)), "coulomb": np.zeros(2)}
    search = LoopSearch(data, scales_of(data), point, np.full(2, 3e-4))
    fit = improve(data, LoopFit(point, (("coulomb",), ("coulomb",))), scales_of(data))
    assert np.all(fit.point["coulomb"] > 0.1)
    kept = not_worse(search, fit, np.array([5e-4, 7e-4]))
    assert kept.point["coulomb"].tolist() == [0.0, fit.point["coulomb"][1]]


def test_what_the_whole_arm_has_stays_where_a_joint_takes_the_models_values(data: Windows) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    seen = with_columns(data)
    point = nominal_point(seen, nominal_controller(sim))
    search = LoopSearch(seen, scales_of(seen), point, np.full(2, 3e-4))
    stuck = {**point, "kp": point["kp"] * [1.0, 0.1], "moment1.x": np.full(2, 0.001)}
    fit = not_worse(search, evaluate(seen, LoopFit(stuck, (("kp",), ("kp",)), ("moment1.x",))), np.full(2, np.inf))
    np.testing.assert_array_equal(fit.point["kp"], point["kp"])
    np.testing.assert_array_equal(fit.point["moment1.x"], [0.001, 0.001])
    assert fit.shared == ("moment1.x",)


def test_a_tilt_turns_the_base_about_its_own_axes() -> None:
    """As it does where a torque is recorded: about the base's x and y, if gravity is along its z."""
    turned = tilt_gravity(np.array([0.0, 0.0, -9.81]), np.array([0.0, 0.1]))
    real = TEXT.replace("<option ", f'<option gravity="{" ".join(map(str, turned))}" ')
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    data = with_columns(windows_of(sim.arm, [record(real, 1, 14.0)], ["run"]))
    point = {**nominal_point(data, nominal_controller(sim)), "tilt.angle_2": np.zeros(2)}
    assert "tilt.angle_1" not in data.columns  # both joints turn about y
    fit = improve(data, LoopFit(point, ((), ()), ("tilt.angle_2",)), scales_of(data))
    assert fit.point["tilt.angle_2"][0] == pytest.approx(0.1, rel=0.06)


def test_a_mass_moment_that_no_arm_can_have_is_not_taken() -> None:
    """Beside a spring as stiff one of a hundred times the arm's own fits its motion, and breaks loose along another."""
    heavier = TEXT.replace('<inertial pos="0.08 0 0" mass="0.3"', '<inertial pos="0.16 0 0" mass="0.3"')
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    data = with_columns(windows_of(sim.arm, [record(heavier, 1, 14.0)], ["run"]))
    search = LoopSearch(data, scales_of(data), nominal_point(data, nominal_controller(sim)), np.full(2, 3e-4))
    effect = "link.mass_moment@elbow"
    whole = {effect: shared_effects(sim.arm)[effect]}
    fit = evaluate(data, LoopFit(search.nominal, ((), ())))
    found = _shared_round(search, fit, whole, 0.0)
    assert found is not None
    assert found.point["moment1.x"][0] == pytest.approx(0.3 * 0.08, rel=0.15)
    assert max(abs(end) for end in data.ranges["moment1.x"]) < 0.5
    narrow = replace(search, data=replace(data, ranges=dict.fromkeys(data.ranges, (-0.01, 0.01))))
    assert _shared_round(narrow, fit, whole, 0.0) is None


def test_a_command_that_arrives_late_moves_the_arm_as_a_later_one(data: Windows) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    point = nominal_point(data, nominal_controller(sim))
    late = simulate(data, batch([{**point, "delay": np.full(2, 4.0 * data.dt)}]))
    shifted = {
        name: np.concatenate([np.repeat(x[:1], 4, axis=0), x[:-4]])
        for name, x in (("command", data.command), ("speed", data.speed), ("feed", data.feed))
    }
    np.testing.assert_allclose(late, simulate(replace(data, **shifted), batch([point])), atol=1e-9)
    assert np.abs(late - simulate(data, batch([point]))).max() > 1e-3


def test_a_joint_that_is_never_commanded_has_no_command() -> None:
    t = np.arange(0.0, 1.0, 0.02)
    command = np.column_stack([np.sin(t), np.full_like(t, np.nan)])
    held, served = held_command(Recording(t=t, position=0.0 * command, position_command=command), t[:-1], 0.02)
    assert np.isfinite(held).all()
    assert (served == [1.0, 0.0]).all()
    assert (held[:, 1] == 0.0).all()
    before = np.sin(np.maximum(t[:-1] - 0.02, 0.0))
    np.testing.assert_allclose(held[:, 0], (before + np.sin(t[:-1])) / 2, atol=1e-12)  # half a step of each about t


def test_windows_are_compared_from_the_end_of_their_opening(data: Windows) -> None:
    assert data.time[0] == pytest.approx(WARM_S, abs=data.dt * data.stride)
    assert data.time[0] == pytest.approx(data.warm * data.dt)


@pytest.mark.parametrize("size", [1.0, 1e-4])
def test_what_columns_explain_is_a_share_whatever_the_residuals_size(size: float) -> None:
    random = np.random.default_rng(1)
    known, new, other = np.linalg.qr(random.normal(size=(60, 3)))[0].T[:, None, :, None]
    residual = size * (3.0 * known[0] - 4.0 * new[0] + 0.0 * other[0])
    share = _explained(residual, known[None, 0], new[None, 0], signed=True)
    assert share == pytest.approx(16.0 / 25.0)
    assert _explained(residual, known[None, 0], -new[None, 0], signed=True) == 0.0
    assert _explained(residual, known[None, 0], other[None, 0], signed=False) == pytest.approx(0.0, abs=1e-9)


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


def test_a_coefficient_of_the_whole_arm_is_one_and_a_joints_is_in_its_own_scale() -> None:
    fit = SimpleNamespace(point={"tilt.x": np.array([0.03]), "coulomb": np.array([0.5, 0.8])})
    search = SimpleNamespace(scales=SimpleNamespace(of=lambda name: np.array([0.1, 0.2])))
    assert coordinate(fit, search.scales, -1, "tilt.x") == 0.03
    assert coordinate(fit, search.scales, 1, "coulomb") == pytest.approx(4.0)


def test_an_effect_of_the_whole_arm_is_taken_out_by_its_own_names(monkeypatch) -> None:
    monkeypatch.setattr(edits, "shared_effects", lambda arm: {"base.tilt": ("tilt.x", "tilt.y"), "other": ("z",)})
    names = ("tilt.x", "tilt.y", "z")
    fit = LoopFit({name: np.array([0.3]) for name in (*names, "kp")}, ((),), names)
    bare = edits.without_group(SimpleNamespace(data=SimpleNamespace(arm=None)), fit, ("base.tilt", ()))
    assert {name: float(x[0]) for name, x in bare.point.items()} == {"tilt.x": 0.0, "tilt.y": 0.0, "z": 0.3, "kp": 0.3}
    assert bare.shared == ("z",)


def test_the_spread_of_a_parameter_is_that_of_least_squares(monkeypatch) -> None:
    """One parameter and white residuals of independent windows: σ² / Σ x², beside what is systematic; over windows and
    over 40 recordings, where both count."""
    random = np.random.default_rng(3)
    x = random.normal(size=(1, 50, 400))
    noise = 0.01 * random.normal(size=(50, 400))
    residual = (noise - x[0] * (x[0] * noise).sum() / (x**2).sum())[:, None]  # what the best value leaves
    monkeypatch.setattr(jackknife, "jacobian", lambda data, fit, scales, active, shared: (residual, [x]))
    monkeypatch.setattr(spread, "errors_of", lambda search: [{}, {}])
    arm = SimpleNamespace(inertial=np.ones((1, 10)))
    data = SimpleNamespace(count=400, joints=1, recording=np.arange(400) // 10, columns={}, arm=arm)
    data.of_one_recording = False
    search = SimpleNamespace(data=data, scales=Scales(*np.ones((4, 1))), samples=np.array([400.0]))
    fit = LoopFit({"kp": np.array([15.0]), **{name: np.zeros(1) for name in spread.SCALED}}, (("kp",),))
    for estimate, times in ((spread.covariance, 2.0), (spread.covariance_within, 1.0)):
        found = estimate(search, fit).matrix[0, 0] - spread.SYSTEMATIC**2
        assert found == pytest.approx(times * 1e-4 / (x**2).sum(), rel=0.25)


def test_of_one_motion_what_is_left_of_the_way_to_the_command_is_what_another_may_show(monkeypatch) -> None:
    """A twentieth of it at the first joint, nothing at the second, half at the third, of which no more is unknown than
    of what a model states; nothing where several recordings show it."""
    monkeypatch.setattr(spread, "rms_on", lambda data, fit: np.array([0.001, 0.0, 0.01]))
    fit = LoopFit(
        {"kp": np.array([15.0, 10.0, 5.0]), "coulomb": np.array([0.3, 0.2, 0.1])}, (("kp", "coulomb"), ("kp",))
    )
    torque, one = np.full(3, 0.5), np.ones(3)
    scales = Scales(torque, one, one, np.full(3, 0.02))
    search = SimpleNamespace(data=SimpleNamespace(of_one_recording=True), scales=scales)
    share = 0.05 * spread.OTHERWISE
    found = np.diag(spread._of_one_motion(search, fit, [(0, "kp"), (0, "coulomb"), (1, "kp"), (2, "kp")]))
    coulomb = share * 0.3 / scales.of("coulomb")[0]
    np.testing.assert_allclose(found, [share**2, coulomb**2, 0.0, spread.STATED**2])
    two = SimpleNamespace(data=SimpleNamespace(of_one_recording=False), scales=scales)
    assert not spread._of_one_motion(two, fit, [(0, "kp")]).any()


def test_a_gain_is_a_logarithm_away_from_the_nominal_one() -> None:
    def distance(name: str, value: float, nominal: float) -> float:
        scales = SimpleNamespace(of=lambda name: np.array([0.5]))
        search = SimpleNamespace(nominal={name: np.array([nominal])}, scales=scales)
        return selection._distance(search, SimpleNamespace(point={name: np.array([value])}), name, 0)

    assert distance("kp", 20.0, 10.0) == pytest.approx(np.log(2.0))
    assert distance("limit", 20.0, np.inf) == np.inf
    assert distance("ki", 20.0, 0.0) == np.inf
    assert distance("coulomb", 2.0, 1.0) == pytest.approx(2.0)


@pytest.mark.parametrize(("lost", "named"), [(0.5 * PRICE, ("actuator.rotor_inertia",)), (2.0 * PRICE, ())])
def test_the_common_scale_is_open_if_half_as_much_again_fits_as_well(monkeypatch, lost: float, named: tuple) -> None:
    monkeypatch.setattr(rivals, "improve", lambda data, fit, scales, iterations: fit)
    names = ("kp", "coulomb", "viscous", "kd", "ki", "stribeck", "armature", "dead")
    fit = LoopFit({name: np.array([2.0, 2.0]) for name in names}, (("kp",), ("kp",)))
    scores = iter([np.array([1.0 + 3.0 * PRICE, 1.0 + lost]), np.array([1.0, 1.0])])
    search = SimpleNamespace(data=None, scales=None, score=lambda fit: next(scores))
    assert rivals._scale_rivals(search, fit) == named


def _searched(text: str, seen: Recording, *looked_for: str) -> tuple[LoopSearch, LoopFit]:
    """The search of some effects from the model with its own controller, and the fit of that model."""
    sim = load_model(mujoco.MjModel.from_xml_string(text))
    data = with_columns(windows_of(sim.arm, [seen], ["run"]))
    point = nominal_point(data, nominal_controller(sim))
    without = frozenset({*EFFECTS, "position.offset", "link.payload", "link.mass_moment", "base.tilt"} - {*looked_for})
    search = LoopSearch(data, scales_of(data), point, np.full(2, 2e-4), without)
    return search, evaluate(data, LoopFit(point, ((), ())))


def test_a_spring_that_a_moved_mass_would_replace_is_confounded_with_it() -> None:
    moved = TEXT.replace('pos="0.08 0 0"', 'pos="0.12 0 0"')
    search, bare = _searched(
        TEXT, record(moved, 1, 14.0), "transmission.spring", "controller.delay", "link.mass_moment"
    )
    fit = improve(search.data, edits.with_effect(search, bare, "transmission.spring", 1), search.scales)
    assert search.score(fit)[1] < search.score(bare)[1] - 2.0 * PRICE
    least, close = rivals.rivals_of(search, fit, ("transmission.spring", (1,)), bare)
    assert "link.mass_moment" in close
    assert least < PRICE


def test_the_joints_beyond_one_feel_its_zero() -> None:
    """A shoulder that reads 0.15 rad too little turns gravity at the elbow too, which is no effect of its own."""
    seen = record(SMOOTH, 1, 14.0)
    assert seen.position_command is not None
    off = np.array([0.15, 0.0])
    shifted = replace(seen, position=seen.position - off, position_command=seen.position_command - off)
    search, bare = _searched(SMOOTH, shifted, "position.offset")
    found = select(search, bare)
    assert found.rms is not None
    assert bare.rms is not None
    assert (judge.joint_rms(search.data, found.rms) < 0.4 * judge.joint_rms(search.data, bare.rms)).all()
    assert found.shared == ("zero0.angle",)
    assert found.point["zero0.angle"][0] == pytest.approx(0.15, rel=0.15)  # its torque is linear in it here


def test_an_offset_is_tried_in_place_of_a_mass_even_if_more_free_effects_promise_more(monkeypatch) -> None:
    """About the last joint both are the same torque, and the one with a parameter promises least."""
    search, bare = _searched(TEXT, record(TEXT, 1, 14.0), "position.offset", "link.payload", "link.mass_moment")
    fit = replace(bare, shared=("moment1.x", "moment1.z"))
    monkeypatch.setattr(rivals, "expected_shared", lambda *given: float(len(given[-1])))
    monkeypatch.setattr(rivals, "improve", lambda data, fit, scales, iterations: evaluate(data, fit))
    tried = [name for name, _ in rivals._of_the_arm(search, fit, ("link.mass_moment@elbow", ()), bare)]
    assert sorted(name.partition("@")[0] for name in tried) == ["link.mass_moment", "link.payload", "position.offset"]


@pytest.mark.parametrize(("group", "lost"), [(("base.tilt", ()), 4.0), (("friction.coulomb", (0,)), 2.0)])
def test_a_rival_is_measured_by_all_that_is_lost_without_the_effect(monkeypatch, group: tuple, lost: float) -> None:
    """Both joints lose 30 prices without it and two with another in its place: a fifteenth, of one joint and of all."""
    base, fit, bare = np.zeros(2), SimpleNamespace(rms=1, name="fit"), SimpleNamespace(rms=1, name="bare")
    scores = {"fit": base, "bare": base + 30.0 * PRICE, "trial": base + 2.0 * PRICE}
    search = SimpleNamespace(data=None, scales=None, excluded=frozenset(), score=lambda fit: scores[fit.name])
    monkeypatch.setattr(rivals, "ranked", lambda search, fit, own: [[(1.0, "controller.delay")]] * 2)
    monkeypatch.setattr(rivals, "with_effect", lambda search, fit, other, place: LoopFit({}, ((), ())))
    monkeypatch.setattr(rivals, "improve", lambda *given: SimpleNamespace(rms=1, name="trial"))
    monkeypatch.setattr(rivals, "_of_the_arm", lambda *given: [])
    least, close = rivals.rivals_of(search, fit, group, bare)
    assert "controller.delay" in close
    elsewhere = 30.0 if group[1] else 0.0  # which the joint's rival does not touch
    assert least == pytest.approx((lost + elsewhere) * PRICE)


@pytest.mark.parametrize(("late", "steps"), [(0.4, 0.0), (2.6, 3.0), (-1.0, 0.0)])
def test_delays_are_told_in_whole_steps(monkeypatch, late: float, steps: float) -> None:
    names = ("kp", "gain", "kv", "viscous", "back_emf", "armature", "coulomb", "limit")
    point = {name: np.ones(1) for name in names}
    found = SimpleNamespace(native=SimpleNamespace(point=point), sim=SimpleNamespace(n=1))
    monkeypatch.setattr(training_files, "_delays", lambda found, j, drawn: 0.002 * np.array([late, late]))
    entry = training_files._entry(found, 0, 0.002, [])
    assert (entry["least"], entry["most"]) == (steps, steps)


def test_a_body_gets_the_inertial_parameters_that_it_is_said_to_have() -> None:
    """Half a kilogram at the elbow's axis: mass and first moment of the fore arm, as MuJoCo compiles it."""
    spec = mujoco.MjSpec.from_string(TEXT)
    compiled = spec.compile()
    change = np.array([0.5, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.005, 0.0, 0.005])  # a point mass at (0.1, 0, 0)
    export._set_body(spec, compiled, 1, change)
    after = spec.compile()
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
    }
    fit = LoopFit({name: np.array([value]) for name, value in own.items()}, (("coulomb", "stribeck", "load"),))
    data = SimpleNamespace(joints=1, load=np.full((5, 1, 2), 4.0), arm=SimpleNamespace(names=()))
    nominal = dict.fromkeys(own, nothing)
    monkeypatch.setattr(export, "improve", lambda data, fit, scales, iterations: fit)
    held = export.native_fit(SimpleNamespace(data=data, nominal=nominal, scales=None), fit)
    assert held.point["coulomb"] == pytest.approx([0.2 + 0.3 + 0.4])
    assert held.point["stribeck"] == held.point["load"] == 0.0


def test_the_opening_of_a_replay_is_not_judged(monkeypatch) -> None:
    t = 5.0 + np.arange(0.0, 4.0, 0.1)
    simulated, measured = np.where(t < 5.95, 7.0, 0.5)[:, None], np.zeros((len(t), 1))
    monkeypatch.setattr(replays, "replay", lambda arm, recording, longest: (t, simulated, measured))
    recording = Recording(t=t, position=measured, position_command=measured)
    assert replays.replay_rms(replays.Simulated(None, (0,)), [recording]) == pytest.approx([0.5])


def test_what_needs_coulomb_friction_is_tried_where_the_model_has_it(data: Windows) -> None:
    """At the joint whose friction is taken away it is not, before Coulomb friction is fitted there."""
    sim = load_model(mujoco.MjModel.from_xml_string(TEXT))
    point = nominal_point(data, nominal_controller(sim))
    point["coulomb"] = np.array([0.2, 0.0])
    about = LoopSearch(data, scales_of(data), point, np.full(2, 1e-4))
    bare = evaluate(data, LoopFit(point, ((), ())))
    first, second = ranked(about, bare, ["friction.asymmetric", "friction.stribeck"])
    assert {effect for _, effect in first} == {"friction.asymmetric", "friction.stribeck"}
    assert second == []
    both = replace(bare, active=(("coulomb", "asymmetry"), ("coulomb", "asymmetry")))
    assert selection._removable(about, both, "friction.coulomb", 0)
    assert not selection._removable(about, both, "friction.coulomb", 1)
