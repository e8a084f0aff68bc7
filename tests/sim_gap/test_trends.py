"""Trends of a fleet: arms that wear are seen before half of the change has happened, the others raise no alarm."""

from datetime import date, timedelta

import numpy as np
import pytest

from sim_gap.trends import date_of, fleet_outliers, fleet_trends

DAYS, ARMS, BEGINS, WEARS = 60, 20, 15, 35
"""Days, arms, day at which wear begins, and days over which it takes place."""
SCATTER = {"torque": 0.02, "damping": 0.03, "width": 0.03, "gain": 0.002}
"""Relative scatter of a parameter from one day's diagnosis to the next."""


def cause(effect: str, joint: str, name: str, value: float) -> dict:
    return {"effect": effect, "parameters": {joint: {name: {"value": value, "unit": "u"}}}}


WORN = {
    "arm_02": ("friction.coulomb", "joint_1", "torque", 0.30),
    "arm_05": ("friction.coulomb", "joint_3", "torque", 0.30),
    "arm_09": ("transmission.backlash", "joint_2", "width", 0.0035),
    "arm_13": ("torque.gain", "joint_2", "gain", -0.03),
    "arm_17": ("friction.viscous", "joint_1", "damping", 0.30),
}


def fleet(seed: int) -> dict[str, dict]:
    """Daily answers of all arms; five of them wear. Play is found only once there is some."""
    random, out = np.random.default_rng(seed), {}
    size = {"torque": 2.0, "damping": 1.0, "gain": 1.1}
    for number in range(ARMS):
        arm = f"arm_{number:02d}"
        own = {name: random.uniform(0.8, 1.2) for name in size}
        own["gain"] = random.uniform(0.98, 1.02)
        for day in range(DAYS):
            worn = float(np.clip((day - BEGINS) / WEARS, 0.0, 1.0))
            causes = []
            for joint in ("joint_1", "joint_2", "joint_3"):
                for effect, name in (
                    ("friction.coulomb", "torque"),
                    ("friction.viscous", "damping"),
                    ("torque.gain", "gain"),
                ):
                    if random.random() < 0.05:
                        continue  # too small to be reported on that day
                    change = WORN[arm][3] * worn if WORN.get(arm, ())[:2] == (effect, joint) else 0.0
                    value = size[name] * own[name] * (1.0 + change) * random.normal(1.0, SCATTER[name])
                    causes.append(cause(effect, joint, name, value))
            if random.random() < 0.45:  # on the verge of what is reported
                causes.append(cause("torque.offset", "joint_1", "torque", 0.1 * random.normal(1.0, 0.05)))
            play = 0.0035 * worn * random.normal(1.0, SCATTER["width"])
            if arm == "arm_09" and play > 0.0008:
                causes.append(cause("transmission.backlash", "joint_2", "width", play))
            when = date(2026, 9, 1) + timedelta(days=day)
            out[f"{arm}/{when.isoformat()}"] = {"causes": causes, "minor": []}
    return out


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_wear_is_seen_before_half_of_it_and_nowhere_else(seed):
    found = fleet_trends(fleet(seed))
    assert {trend.arm: (trend.effect, trend.joint, trend.parameter) for trend in found} == {
        arm: worn[:3] for arm, worn in WORN.items()
    }
    assert len(found) == len(WORN)
    half = date(2026, 9, 1) + timedelta(days=BEGINS + WEARS // 2)
    for trend in found:
        assert date.fromisoformat(trend.noticed) < half
        assert abs((date.fromisoformat(trend.since) - date(2026, 9, 1)).days - BEGINS) <= 10
        assert np.sign(trend.now - trend.before) == np.sign(WORN[trend.arm][3])


def with_watched(days: int, play: float, first: int = 0) -> dict[str, dict]:
    """Answers of one arm without a cause; a play that is watched from day `first` on grows from day 20 on."""
    random, out = np.random.default_rng(5), {}
    for day in range(days):
        value = 1e-4 * random.normal() + play * max(day - 20, 0) / 20.0
        rows = [
            {
                "effect": effect,
                "joint": "joint_1",
                "parameter": name,
                "value": x,
                "ci95": [x - 0.01, x + 0.01],
                "unit": "",
            }
            for effect, name, x in (
                ("transmission.backlash", "width", value),
                ("friction.coulomb", "torque", 1.0 + 0.01 * random.normal()),
            )
        ]
        known = {"watched": rows} if day >= first else {}
        out[f"arm/{date(2026, 9, 1) + timedelta(days=day)}"] = {"causes": [], "minor": [], **known}
    return out


def test_what_is_watched_is_followed_without_a_cause():
    (one,) = fleet_trends(with_watched(40, 0.0035))
    assert (one.effect, one.joint, one.parameter) == ("transmission.backlash", "joint_1", "width")
    assert date.fromisoformat(one.noticed) < date(2026, 9, 1) + timedelta(days=30)
    assert fleet_trends(with_watched(40, 0.0)) == []


def test_what_is_watched_only_from_some_day_on_has_not_changed_by_that():
    assert fleet_trends(with_watched(60, 0.0, first=8)) == []
    assert fleet_trends(with_watched(60, 0.0, first=55)) == []


def test_a_day_on_which_a_joint_hardly_moved_does_not_count():
    answers = with_watched(40, 0.0)
    for case in list(answers)[30:34]:
        width = answers[case]["watched"][0]
        width |= {"value": 0.5, "ci95": [-1.0, 2.0]}
    assert fleet_trends(answers) == []


def test_an_arm_that_differs_from_the_fleet_is_named_without_dates():
    random = np.random.default_rng(4)
    answers = {
        f"arm_{arm}/run_{run}": {
            "causes": [
                cause("friction.coulomb", "joint_1", "torque", (3.0 if arm == 6 else 2.0) * random.normal(1.0, 0.03))
            ]
        }
        for arm in range(8)
        for run in range(2)
    }
    (one,) = fleet_outliers(answers)
    assert (one.arm, one.joint, one.value) == ("arm_6", "joint_1", pytest.approx(3.0, rel=0.1))
    assert fleet_trends(answers) == []


@pytest.mark.parametrize(
    ("case", "expected"),
    [("arm/2026-10-02", (2026, 10, 2, 0)), ("a-2/train_20261002T0830.mcap", (2026, 10, 2, 8)), ("arm/run_1", None)],
)
def test_the_date_stands_in_the_name(case, expected):
    found = date_of(case)
    assert (None if found is None else (found.year, found.month, found.day, found.hour)) == expected
