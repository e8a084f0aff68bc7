"""What is written for training moves as the arm does: with its module, and with the gain of each recording."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import mujoco
import numpy as np
import pytest
from servo_arm import at_both, model_text, record, search_on, written

from armlink.recording.recording import Recording
from sim_gap.attribution.position_answer import _ranges
from sim_gap.better_model.export import module_text
from sim_gap.model.load import SimModel, load_model
from sim_gap.position_gap.fit import LoopFit, LoopSearch
from sim_gap.position_gap.training.export import (
    IN_MODULE,
    Exported,
    export_fit,
    export_with_module,
    native_fit,
    widen_ranges,
    widened_joints,
)
from sim_gap.position_gap.training.replay import Simulated, commanded_rows, replay, replay_rms, simulated_model

GAIN, LOAD = 15.0, 0.4
TEXT = model_text(kp=GAIN, friction=0.05)
OTHER = record(TEXT, 3, 21.0, load=LOAD)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[SimModel, LoopSearch, LoopFit]:
    """An arm whose gears rub under load, and the fit that knows it."""
    sim = load_model(written(tmp_path_factory.mktemp("arm"), TEXT))
    search = search_on(TEXT, [record(TEXT, seed, 14.0, load=LOAD) for seed in (1, 2)])
    known = at_both("kp", "coulomb", "viscous", "load")
    return sim, search, search.improve(LoopFit({**search.nominal, "load": np.full(2, 0.1)}).freed(known), 4)


def loaded(sim: SimModel, beside: Exported) -> Simulated:
    """The model with the module as a stranger gets it: from their texts."""
    module = ModuleType("closed_effects")
    exec(module_text(sim, beside.effects, "closed_effects.xml"), module.__dict__)
    assert module.MODEL == "closed_effects.xml"
    model = mujoco.MjModel.from_xml_string(beside.xml)
    return Simulated(model, sim.joints, module.Effects(model))


def test_the_module_holds_friction_under_load_that_the_model_alone_cannot(made) -> None:
    sim, search, fit = made
    assert fit.point["load"] == pytest.approx([LOAD, LOAD], rel=0.15)
    beside, alone = export_with_module(sim, search, fit), export_fit(sim, search, fit, native_fit(search, fit))
    assert alone.lines == ("friction.load elbow", "friction.load shoulder")
    assert beside.lines == ()
    assert [(effect, joint) for effect, joint, _ in beside.effects] == [
        ("friction.load", "shoulder"),
        ("friction.load", "elbow"),
    ]
    with_it, without = (
        replay_rms(each, [OTHER]) for each in (loaded(sim, beside), simulated_model(sim, replace(beside, effects=())))
    )
    left_alone = replay_rms(simulated_model(sim, alone), [OTHER])
    assert (with_it < 0.7 * left_alone).all()
    assert (with_it < 0.3 * without).all()
    assert (with_it < 2.0 * np.pi / 4096.0).all()  # a count of the arm's encoders


def test_the_model_with_a_module_says_what_neither_holds(made) -> None:
    sim, search, fit = made
    fed = fit.with_values(feed=np.array([0.2, 0.0])).freed([*fit.free, (0, "feed")])
    beside = export_with_module(sim, search, fed)
    assert beside.lines == ("controller.feed_forward shoulder",)
    assert "controller.feed_forward shoulder" in beside.xml


def test_the_replay_leaves_the_model_and_mujoco_as_they_were(made) -> None:
    arm = loaded(made[0], export_with_module(*made))
    friction = arm.model.dof_frictionloss.copy()
    replay(arm, OTHER)
    np.testing.assert_array_equal(arm.model.dof_frictionloss, friction)
    assert mujoco.get_mjcb_passive() is None


def test_a_fit_without_such_friction_needs_no_module(made) -> None:
    sim, search, fit = made
    bare = fit.with_values(load=np.zeros(2)).freed(at_both("kp", "coulomb", "viscous"))
    assert export_with_module(sim, search, bare) is None
    assert set(IN_MODULE) == {"friction.stribeck", "friction.load", "friction.asymmetric"}


@pytest.mark.parametrize("kind", ["position", "pid"])
def test_a_recording_with_another_gain_is_replayed_with_that_gain(tmp_path: Path, kind: str) -> None:
    """Against a model whose actuators have that gain from the start."""

    def arm(kp: float) -> Simulated:
        spec = mujoco.MjSpec.from_string(model_text(kp=kp, friction=0.2))
        for actuator in spec.actuators:
            if kind == "pid":
                actuator.set_to_pid(kp=kp, kv=0.3, ki=0.5 * kp, slewmax=2.0, ctrlspec=1)
        return Simulated(spec.compile(), (0, 1))

    low = arm(GAIN)
    np.testing.assert_allclose(replay(low.with_gain(4.0), OTHER)[1], replay(arm(4.0 * GAIN), OTHER)[1], atol=1e-9)
    assert np.abs(replay(low, OTHER)[1] - replay(low.with_gain(4.0), OTHER)[1]).max() > 0.05
    apart = replay_rms(low, [OTHER, OTHER], [1.0, 4.0]) ** 2
    both = replay_rms(low, [OTHER]) ** 2 + replay_rms(low.with_gain(4.0), [OTHER]) ** 2
    np.testing.assert_allclose(2.0 * apart, both)


def test_commands_are_angles_of_the_joint_whatever_the_gear() -> None:
    plain, geared = (mujoco.MjSpec.from_string(model_text(kp=GAIN, friction=0.2)) for _ in range(2))
    for actuator in geared.actuators:
        actuator.gear[0] = 3.0
        actuator.gainprm, actuator.biasprm = actuator.gainprm / 9.0, actuator.biasprm / 9.0
    moved = [replay(Simulated(spec.compile(), (0, 1)), OTHER)[1] for spec in (plain, geared)]
    np.testing.assert_allclose(*moved, atol=1e-9)


@pytest.mark.parametrize("compiler", ["", '<compiler angle="radian"/>'])
def test_a_spring_is_written_in_the_angles_of_the_file(made, tmp_path: Path, compiler: str) -> None:
    _, search, fit = made
    sim = load_model(written(tmp_path, TEXT.replace("<option", f"{compiler}<option", 1)))
    sprung = fit.with_values(spring=np.array([2.0, 0.0]), offset=np.array([0.6, 0.0]))
    model = mujoco.MjModel.from_xml_string(export_fit(sim, search, sprung, sprung).xml)
    assert model.jnt_stiffness.ravel()[0] == pytest.approx(2.0)
    assert model.qpos_spring[0] == pytest.approx(-0.3)


@pytest.mark.sample(1)
@pytest.mark.parametrize(("compiler", "unit"), [("", np.degrees(1.0)), ('<compiler angle="radian"/>', 1.0)])
def test_a_joint_of_the_written_model_goes_as_far_as_the_arm(made, tmp_path: Path, compiler: str, unit: float) -> None:
    """The shoulder left the model's range, the elbow did not."""
    _, search, fit = made
    shoulder, elbow = OTHER.position.T
    text = TEXT.replace("<option", f"{compiler}<option", 1)
    text = text.replace('name="shoulder" axis', f'name="shoulder" range="{-9 * unit} {0.2 * unit}" limited="true" axis')
    text = text.replace('name="elbow" axis', f'name="elbow" range="{-9 * unit} {9 * unit}" limited="true" axis')
    text = text.replace('joint="shoulder" kp', 'joint="shoulder" ctrllimited="true" ctrlrange="-9 0.2" kp')
    sim = load_model(written(tmp_path, text))
    wide = widen_ranges(sim, [OTHER])
    assert widened_joints(sim) == []
    assert widened_joints(wide) == [0]
    kept, free = (simulated_model(each, export_fit(each, search, fit, native_fit(search, fit))) for each in (sim, wide))
    assert free.model.jnt_range[0] == pytest.approx([-9.0, shoulder.max() + 0.01])
    assert free.model.jnt_range[1] == pytest.approx([-9.0, 9.0])
    assert elbow.max() < 9.0
    stopped, moved = (replay_rms(each, [OTHER])[0] for each in (kept, free))
    assert moved < 0.3 * stopped
    found = SimpleNamespace(sim=wide)
    (note,) = _ranges(found)
    assert "shoulder (model -9.00 to 0.20 rad" in note
    assert "elbow" not in note


@pytest.mark.parametrize(
    ("given", "longest", "expected"),
    [
        ([1, 1, 1, 1, 1, 1], 60.0, [slice(0, 6)]),
        ([1, 1, 1, 1, 1, 1], 0.25, [slice(0, 3)]),
        ([0, 0, 1, 1, 1, 0], 60.0, [slice(2, 5)]),
        ([1, 1, 1, 0, 1, 1], 60.0, [slice(0, 3)]),
        ([0, 0, 0, 0, 0, 1], 60.0, []),
        ([0, 0, 0, 0, 0, 0], 60.0, []),
    ],
)
def test_a_replay_takes_what_is_commanded_without_a_break(given, longest, expected) -> None:
    command = np.where(np.array(given, bool)[:, None], 0.1, np.nan) * np.ones(2)
    recording = Recording(t=5.0 + 0.1 * np.arange(6), position=np.zeros((6, 2)), position_command=command)
    assert commanded_rows(recording, longest) == expected


def test_a_recording_that_begins_with_the_servos_off_is_replayed_from_where_they_are_on() -> None:
    arm = Simulated(mujoco.MjModel.from_xml_string(model_text(kp=GAIN, friction=0.1)), (0, 1))
    late = OTHER.position_command.copy()
    late[:40] = np.nan
    later = replace(OTHER, position_command=late)
    t, simulated_positions, measured = replay(arm, later)
    assert t[0] == OTHER.t[40]
    np.testing.assert_array_equal(measured, OTHER.position[40:])
    whole = replay(arm, OTHER)[1][-1]
    np.testing.assert_allclose(simulated_positions[-1], whole, atol=1e-3)
    assert np.isfinite(replay_rms(arm, [later])).all()
    never = replace(OTHER, position_command=np.full_like(late, np.nan))
    assert [len(each) for each in replay(arm, never)] == [0, 0, 0]
    assert np.isnan(replay_rms(arm, [never])).all()
