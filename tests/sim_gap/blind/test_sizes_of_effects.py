"""How large effects are drawn, and on which joints: those that can show them, at a size that shows."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from sim_gap.blind import recipe
from sim_gap.blind.arms import draw_arm
from sim_gap.blind.effects import DRAWS, controller
from sim_gap.blind.effects.drawn_effect import DrawnEffect
from sim_gap.blind.motion import RATE
from sim_gap.blind.recipe import OTHER_PAIR, CaseRecipe
from sim_gap.blind.scene import Scene
from sim_gap.commands.gap_bench import _percent

K = 400
STEP_S = 0.05
"""Between two rows of a scene [s]."""


def scene(torques: np.ndarray, turn: float = 1.0) -> Scene:
    """An arm along a motion with these torques (K, n) [N·m]; an angle error of 1 rad changes each by `turn` [N·m]."""
    n = torques.shape[1]
    t = STEP_S * np.arange(len(torques))
    velocity = np.column_stack([0.5 * np.sin((1.0 + j) * t) for j in range(n)])
    arm = SimpleNamespace(n=n, names=tuple(f"joint_{j + 1}" for j in range(n)), armature=np.full(n, 0.1))
    made = Scene(arm, np.zeros((round(STEP_S * len(torques) * RATE), n)))
    vars(made).update(
        torque=torques,
        rotor_torque=np.zeros_like(torques),
        motion=(velocity, velocity, velocity),
        inertia=np.full(n, 0.5),
        link_inertia=np.full(n, 0.4),
        slope=np.broadcast_to(turn * np.eye(n), (len(torques), n, n)),
    )
    return made


def settings(drawn: DrawnEffect) -> dict[str, dict[str, float]]:
    """What the simulated arm gets, by effect."""
    assert all(setting.joint in drawn.joints for setting in drawn.settings)
    return {setting.effect: setting.parameters for setting in drawn.settings}


def swing(hz: float, size: float, mean: float = 0.0) -> np.ndarray:
    """A torque [N·m], (K,)."""
    return mean + size * np.sin(2 * np.pi * hz * STEP_S * np.arange(K) + 0.3)


def rng() -> np.random.Generator:
    return np.random.default_rng(2)


def test_a_gain_error_is_that_of_a_joint_with_enough_torque() -> None:
    """On the weak one, the least error that shows would be more than a quarter."""
    drawn = DRAWS["torque.gain"](scene(np.column_stack([swing(0.2, 0.1), swing(0.2, 5.0)])), rng())
    assert drawn is not None
    assert drawn.joints == ("joint_2",)
    assert 0.06 <= abs(settings(drawn)["torque.gain"]["gain"] - 1.0) <= 0.14


def test_hysteresis_is_drawn_where_the_torque_swings_and_not_where_it_is_large() -> None:
    both = scene(np.column_stack([swing(0.2, 1.0, mean=40.0), swing(0.2, 5.0)]))
    assert {DRAWS["torque.hysteresis"](both, np.random.default_rng(seed)).joints for seed in range(8)} == {("joint_2",)}
    assert DRAWS["torque.hysteresis"](scene(swing(0.2, 1.0, mean=40.0)[:, None]), rng()) is None


def test_a_sensor_saturates_within_its_torque() -> None:
    torques = np.column_stack([swing(0.2, 5.0), swing(0.13, 3.0)])
    drawn = DRAWS["torque.saturation"](scene(torques), rng())
    assert drawn is not None
    j = ("joint_1", "joint_2").index(drawn.joints[0])
    limit = drawn.parameters[drawn.joints[0]]["limit"]
    lost = np.maximum(np.abs(torques[:, j]) - limit, 0.0)
    assert np.sqrt(np.mean(lost**2)) > 0.06 * np.sqrt(np.mean(torques[:, j] ** 2))
    assert settings(drawn) == {"torque.saturation": {"limit": limit}}


def test_a_lag_is_drawn_on_a_joint_whose_torque_changes() -> None:
    drawn = DRAWS["actuator.lag"](scene(np.column_stack([np.full(K, 5.0), swing(1.0, 5.0)])), rng())
    assert drawn is not None
    assert drawn.joints == ("joint_2",)
    time = settings(drawn)["actuator.lag"]["time"]
    assert time == drawn.parameters["joint_2"]["time"]
    assert 0.008 <= time <= 0.016


def test_stribeck_friction_lies_on_top_of_coulombs() -> None:
    """Of the arm alone, or of the nominal model too."""
    nominal = 0
    for seed in range(8):
        drawn = DRAWS["friction.stribeck"](scene(swing(0.2, 5.0)[:, None]), np.random.default_rng(seed))
        put = settings(drawn)
        breakaway = put["friction.stribeck"]["breakaway"]
        arm = draw_arm(np.random.default_rng(seed), 3)
        known = float(drawn.nominal(arm).frictionloss[0])
        if "friction.coulomb" in put:
            assert drawn.implied == ("friction.coulomb",)
            assert known == arm.frictionloss[0]
        else:
            nominal += 1
        assert 0.8 * breakaway < put.get("friction.coulomb", {"torque": known})["torque"] < 1.6 * breakaway
        assert drawn.parameters["joint_1"] == put["friction.stribeck"]
    assert 0 < nominal < 8


def test_backlash_is_drawn_on_a_joint_whose_torque_changes_sign_often() -> None:
    """Four reversals in twenty seconds are often; one is not."""
    assert DRAWS["transmission.backlash"](scene(swing(0.1, 5.0)[:, None], turn=100.0), rng()) is not None
    once = np.where(np.arange(K) < 200, 5.0, -5.0)
    assert DRAWS["transmission.backlash"](scene(once[:, None], turn=100.0), rng()) is None


def test_a_servos_integral_part_is_the_one_that_is_told() -> None:
    law = SimpleNamespace(stiffness=np.array([20.0, 50.0]), integral=np.zeros(2))
    moved = scene(np.column_stack([swing(0.2, 1.0)] * 2))
    moved.law = law
    change = controller.DRAWS["controller.integral"](moved, rng())
    change.law(law)
    (name,) = change.parameters
    j = ("joint_1", "joint_2").index(name)
    assert law.integral[j] == change.parameters[name]["ki"]
    assert 0.5 * law.stiffness[j] <= law.integral[j] <= 2.0 * law.stiffness[j]
    assert law.integral[1 - j] == 0.0


@pytest.fixture
def hopeless(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """Arms that show no effect: the effects that were tried."""
    tried: list[tuple[str, ...]] = []

    def named(effects: tuple[str, ...], scene: object, random: np.random.Generator) -> None:
        tried.append(effects)

    for name in ("draw_arm", "_limits", "trajectory", "Scene"):
        monkeypatch.setattr(recipe, name, lambda *given: None)
    monkeypatch.setattr(recipe, "_named", named)
    monkeypatch.setattr(recipe, "ATTEMPTS", 3 * OTHER_PAIR)
    return tried


def test_other_pairs_are_drawn_for_arms_that_cannot_show_one(hopeless: list[tuple[str, ...]]) -> None:
    pair = ("torque.gain", "torque.offset")
    assert recipe.draw(CaseRecipe("case_0000", pair, (3, 1)), 1.0, 1.0) is None
    assert set(hopeless[:OTHER_PAIR]) == {pair}
    assert len(set(hopeless)) == 3
    assert all(len(effects) == 2 for effects in hopeless)


def test_a_single_effect_is_kept_whatever_arm_is_drawn(hopeless: list[tuple[str, ...]]) -> None:
    assert recipe.draw(CaseRecipe("case_0000", ("torque.gain",), (3, 1)), 1.0, 1.0) is None
    assert set(hopeless) == {("torque.gain",)}


def test_of_several_effects_a_payload_counts_as_one_of_the_last_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slow motion cannot separate it from a mass moment of that link; it can from one of another link."""

    def drawn(effect: str, joint: str) -> DrawnEffect:
        return DrawnEffect(effect, {joint: {}})

    arm = SimpleNamespace(arm=SimpleNamespace(names=("joint_1", "joint_2")))
    for joint, found in (("joint_2", False), ("joint_1", True)):
        own = {"link.payload": drawn("link.payload", "arm"), "link.mass_moment": drawn("link.mass_moment", joint)}
        draws = {name: partial(lambda each, *_: each, each) for name, each in own.items()}
        monkeypatch.setattr(recipe, "DRAWS", dict.fromkeys(recipe.EFFECTS, lambda *_: None) | draws)
        assert (recipe._several(2, arm, rng()) is not None) is found


def test_a_share_of_nothing_is_a_dash() -> None:
    assert [_percent(value) for value in (None, 0.0, 0.857)] == ["–", "0.0 %", "85.7 %"]
