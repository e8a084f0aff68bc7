"""The effect catalogue: every form of the effects covers it or gives a reason, and the documentation lists the same."""

import re
from pathlib import Path

import numpy as np
import pytest

from armlink.effect_catalogue import CATALOGUE
from calib.fit import unmodelled_effects
from calib.observer.cause_test import CAUSES
from sim_bus.effects.registry import NOT_SIMULATED
from sim_bus.effects.registry import effects as forward_effects
from sim_gap.blind.arms import draw_arm
from sim_gap.blind.effects import DRAWS
from sim_gap.blind.motion import MotionLimits, trajectory
from sim_gap.blind.scene import Scene
from sim_gap.effects.registry import NOT_DIAGNOSED, effects, library_without

DOCS = Path(__file__).parents[2] / "docs"
ID = re.compile(r"`([a-z]+\.[a-z_]+)`")
FORMS = {
    "forward": (set(forward_effects()), NOT_SIMULATED),
    "inverse": (set(library_without([])), NOT_DIAGNOSED),
    "blind": (set(DRAWS), NOT_SIMULATED),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_form_covers_the_catalogue_or_says_why_not(form: str) -> None:
    covered, left_out = FORMS[form]
    assert covered | set(left_out) == set(CATALOGUE)
    assert not covered & set(left_out)
    assert all(left_out.values())


def test_the_catalogue_describes_each_effect_and_its_units() -> None:
    for effect_id, entry in CATALOGUE.items():
        assert re.fullmatch(r"[a-z]+\.[a-z_]+", effect_id)
        assert entry.id == effect_id
        assert entry.description
        assert not entry.description.endswith(".")
        assert entry.parameters
        assert all(parameter.unit for parameter in (*entry.parameters, *entry.estimated))
        names = [name for name, _ in entry.reported]
        assert len(set(names)) == len(names)


def test_the_forms_share_parameters_and_units() -> None:
    for effect_id, effect in forward_effects().items():
        entry = CATALOGUE[effect_id]
        assert [(p.name, p.unit) for p in effect.parameters] == [(p.name, p.unit) for p in entry.parameters]
        assert effect.per_joint is not entry.whole_arm
    for effect_id in library_without([]):
        assert effects()[effect_id].reported == CATALOGUE[effect_id].reported
        assert effects()[effect_id].signature.whole_arm is CATALOGUE[effect_id].whole_arm


def test_the_blind_effects_have_parameters_of_the_catalogue() -> None:
    random, drawn = np.random.default_rng(1), set()
    for _ in range(2):
        arm = draw_arm(random, 5)
        limits = MotionLimits(arm.lower, arm.upper, np.full(5, 1.5), np.full(5, 5.0))
        scene = Scene(arm, trajectory(("points", "sines"), 10.0, limits, random))
        found = [each for draw in DRAWS.values() if (each := draw(scene, random)) is not None]
        for each in found:
            names = {name for values in each.parameters.values() for name in values}
            assert names <= {name for name, _ in CATALOGUE[each.effect].reported}, each.effect
        drawn |= {each.effect for each in found}
    assert len(drawn) > 0.5 * len(DRAWS)


def test_the_sensor_fit_and_the_cause_test_use_its_ids() -> None:
    assert {effect for effects in CAUSES.values() for effect in effects} <= set(CATALOGUE)
    source = Path(unmodelled_effects.__file__).read_text(encoding="utf-8")
    tried = set(re.findall(r'"([a-z]+\.[a-z_]+)"', source))
    assert tried
    assert tried <= set(CATALOGUE)


def test_the_documentation_lists_the_catalogue() -> None:
    formats = (DOCS / "formats.md").read_text(encoding="utf-8").partition("### 5.1")[2].partition("### 5.2")[0]
    assert set(ID.findall(formats)) - {"sim.effects"} == set(CATALOGUE)
    simulated = (DOCS / "simulated-arm.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `([a-z]+\.[a-z_]+)` \|", simulated, re.M)) == set(CATALOGUE) - set(NOT_SIMULATED)
