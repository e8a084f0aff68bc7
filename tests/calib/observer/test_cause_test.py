"""The cause test against the Monte Carlo table of docs/theory.md, section 6."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from drawn_arms import drawn_arm
from effects_on_readings import SIGMA, payload

from calib.arm.kinematics import gcomp_arm
from calib.observer.cause_test import CauseTest
from calib.observer.evidence import Verdict, smallest_noticed_change, span
from calib.observer.gravity_belief import GravityBelief, dictionary
from gcomp.arm.arm import Arm
from gcomp.arm.mass_moments import payload_columns
from gcomp.gravity.torque import gravity_regressor, gravity_stiffness, gravity_torque
from gcomp.identify.readings import StaticReadings

MODEL_STD = np.repeat([4.4, 4.5, 1.3, 0.9, 0.5, 0.4, 0.3], 2) * 1e-3
"""Errors of a good calibration, kg·m (docs/theory.md, section 6)."""

Effect = Callable[[Arm, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.random.Generator], str]
"""(arm, beta, q, direction, readings to change, random) -> the right answer."""


def window(q: np.ndarray, v: np.ndarray, direction: np.ndarray) -> StaticReadings:
    return StaticReadings(q, v, np.full(q.shape[1], SIGMA), direction=direction)


def nothing(arm, beta, q, direction, v, random):
    return "none"


def gain(change):
    def effect(arm, beta, q, direction, v, random):
        j = random.integers(arm.n)
        v[:, j] *= 1 + change
        return f"drift {j}"

    return effect


def offset(change):
    def effect(arm, beta, q, direction, v, random):
        j = random.integers(arm.n)
        v[:, j] += change
        return f"drift {j}"

    return effect


def both(gain_change, offset_change):
    def effect(arm, beta, q, direction, v, random):
        j = random.integers(4)  # joints that gravity loads enough to tell a gain in 20 rows
        v[:, j] = v[:, j] * (1 + gain_change) + offset_change
        return f"both {j}"

    return effect


def two_drifts(arm, beta, q, direction, v, random):
    first, second = random.choice(4, 2, replace=False)
    v[:, first] *= 1.03
    v[:, second] += 0.4
    return f"two drifts {sorted([int(first), int(second)])}"


def friction(torque):
    def effect(arm, beta, q, direction, v, random):
        j = random.integers(arm.n)
        v[:, j] += torque * direction[:, j]
        return f"friction {j}"

    return effect


def spring(stiffness):
    def effect(arm, beta, q, direction, v, random):
        j = random.integers(arm.n)
        v[:, j] += stiffness * (q[:, j] - 0.1)
        return f"spring {j}"

    return effect


def slip(angle):
    def effect(arm, beta, q, direction, v, random):
        j = random.integers(1, arm.n - 1)  # joint 1's is inside tilt, joint 7 too weak
        v += gravity_stiffness(arm, beta, q)[:, :, j] * angle
        return f"slip {j}"

    return effect


def tilt(angle):
    def effect(arm, beta, q, direction, v, random):
        across = np.cross(arm.gravity, random.normal(size=3))
        across *= angle * np.linalg.norm(arm.gravity) / np.linalg.norm(across)
        v += gravity_torque(replace(arm, gravity=across), beta, q)
        return "tilt"

    return effect


def contact(newton):
    """A force on the origin of the last frame, another one in each pose."""

    def effect(arm, beta, q, direction, v, random):
        for row, pose in enumerate(q):
            force = random.normal(size=3)
            force *= newton / np.linalg.norm(force)
            at_origin, _ = payload_columns(arm)
            v[row] += gravity_regressor(replace(arm, gravity=force), pose[None])[0] @ at_origin
        return "unknown"

    return effect


def payload_and_drift(arm, beta, q, direction, v, random):
    payload(0.5)(arm, beta, q, direction, v, random)
    v[:, 1] *= 1.01
    return "unknown"


def verdict(arm, beta, effect, rows, random, model_std=None) -> tuple[str, Verdict]:
    q = random.uniform(arm.lower, arm.upper, (rows, arm.n))
    direction = random.choice([-1.0, 1.0], (rows, arm.n))
    v = gravity_torque(arm, beta, q)
    truth = effect(arm, beta, q, direction, v, random)
    v += SIGMA * random.normal(size=v.shape)
    std = np.zeros(beta.size) if model_std is None else model_std
    belief = GravityBelief(arm, beta + std * random.normal(size=beta.size), np.diag(std**2))
    return truth, CauseTest(belief, window(q, v, direction)).verdict()


def answer(truth: str, said: Verdict) -> str:
    """The verdict in the words of the truth: gain, offset and both count as drift unless both is asked for."""
    if said.beside is not None:
        return f"two drifts {sorted(said.joints)}"
    cause = "both" if said.cause == "drift" and truth.startswith("both") else "drift" if said.is_drift else said.cause
    return cause if said.joint is None else f"{cause} {said.joint}"


def share_right(arm, beta, effect, rows, trials=30, model_std=None) -> tuple[float, Counter]:
    random = np.random.default_rng(6)
    results = [verdict(arm, beta, effect, rows, random, model_std) for _ in range(trials)]
    said = Counter(answer(truth, was) for truth, was in results)
    return float(np.mean([answer(truth, was) == truth for truth, was in results])), said


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("effect", "rows", "least"),
    [  # `least` is the table's figure less three standard deviations of 30 trials
        pytest.param(nothing, 20, 0.95, id="none"),
        pytest.param(gain(0.01), 20, 0.36, id="gain 1 %, 20 rows"),
        pytest.param(gain(0.01), 60, 0.51, id="gain 1 %, 60 rows"),
        pytest.param(gain(0.03), 60, 0.70, id="gain 3 %, 60 rows"),
        pytest.param(offset(0.2), 20, 0.83, id="offset 0.2 N·m"),
        pytest.param(payload(0.05), 20, 0.94, id="payload 50 g"),
        pytest.param(payload(0.5), 5, 0.94, id="payload 0.5 kg, 5 rows"),
        pytest.param(payload(2.0), 20, 0.99, id="payload 2 kg"),
        pytest.param(friction(0.2), 20, 0.99, id="friction"),
        pytest.param(spring(0.3), 20, 0.99, id="spring"),
        pytest.param(slip(np.radians(0.5)), 60, 0.70, id="slip"),
        pytest.param(tilt(np.radians(0.3)), 60, 0.75, id="tilt"),
        pytest.param(contact(5.0), 20, 0.99, id="contact"),
        pytest.param(payload_and_drift, 20, 0.99, id="payload and drift"),
    ],
)
def test_verdicts_are_as_often_right_as_the_theory_says(sarcos, sarcos_beta, effect, rows, least) -> None:
    right, said = share_right(sarcos, sarcos_beta, effect, rows)
    assert right >= least, said


def test_gain_and_offset_drift_of_one_joint_at_once_are_found_as_both(sarcos, sarcos_beta) -> None:
    right, said = share_right(sarcos, sarcos_beta, both(0.03, 0.3), 20)
    assert right >= 0.9, said


def test_two_joints_that_drift_at_once_are_both_named(sarcos, sarcos_beta) -> None:
    right, said = share_right(sarcos, sarcos_beta, two_drifts, 20)
    assert right >= 0.8, said


@pytest.mark.sample(1)
@pytest.mark.parametrize("mass", [0.02, 0.05, 0.25, 1.0, 3.0])
def test_a_payload_is_never_called_drift(sarcos, sarcos_beta, mass) -> None:
    _, said = share_right(sarcos, sarcos_beta, payload(mass), 20, trials=60)
    assert not [word for word in said if "drift" in word]


def test_a_payload_comes_with_its_mass(sarcos, sarcos_beta) -> None:
    random = np.random.default_rng(1)
    masses = [verdict(sarcos, sarcos_beta, payload(0.5), 20, random)[1].values[0] for _ in range(20)]
    assert np.sqrt(np.mean((np.array(masses) - 0.5) ** 2)) < 0.005  # theory: 3.2 g


@pytest.mark.sample(1)
@pytest.mark.parametrize(
    ("effect", "least"),
    [(offset(0.2), 0.93), (nothing, 0.97), (payload(0.25), 0.97)],
    ids=["offset", "none", "payload"],
)
def test_an_imperfect_model_does_not_spoil_the_verdict(sarcos, sarcos_beta, effect, least) -> None:
    right, said = share_right(sarcos, sarcos_beta, effect, 60, model_std=MODEL_STD)
    assert right >= least, said


def test_the_estimate_holds_the_truth_as_often_as_its_covariance_says(sarcos, sarcos_beta) -> None:
    random = np.random.default_rng(3)
    scores = []
    for _ in range(60):
        q = random.uniform(sarcos.lower, sarcos.upper, (20, 7))
        v = gravity_torque(sarcos, sarcos_beta, q)
        v[:, 2] = 1.03 * v[:, 2] + 0.3
        v += SIGMA * random.normal(size=v.shape)
        belief = GravityBelief(sarcos, sarcos_beta + MODEL_STD * random.normal(size=14), np.diag(MODEL_STD**2))
        test = CauseTest(belief, window(q, v, np.ones_like(q)))
        change, covariance = test.drift(2, "drift")
        error = change - (0.03, 0.3)
        scores.append(float(error @ np.linalg.solve(covariance, error)))
    assert np.mean(np.array(scores) < 5.99) == pytest.approx(0.95, abs=0.07)  # χ²₂ at 95 %


def test_the_dictionary_is_the_derivative_of_the_torque(sarcos, sarcos_beta) -> None:
    """Slip, tilt and payload columns against finite differences of the gravity torque."""
    random = np.random.default_rng(5)
    q = random.uniform(sarcos.lower, sarcos.upper, (4, 7))
    poses = window(q, np.zeros_like(q), np.ones_like(q))
    entries = {(entry.cause, entry.joint): entry.columns for entry in dictionary(sarcos, sarcos_beta, poses)}
    step = 1e-6
    for joint in range(7):
        turn = step * np.eye(7)[joint]
        central = gravity_torque(sarcos, sarcos_beta, q + turn) - gravity_torque(sarcos, sarcos_beta, q - turn)
        np.testing.assert_allclose(entries["slip", joint].ravel(), central.ravel() / (2 * step), atol=1e-6)
    angle = 1e-6
    turned = replace(sarcos, gravity=9.81 * np.array([np.cos(angle), np.sin(angle), 0.0]))
    change = (gravity_torque(turned, sarcos_beta, q) - gravity_torque(sarcos, sarcos_beta, q)) / angle
    fitted = entries["tilt", None] @ np.linalg.lstsq(entries["tilt", None], change.ravel(), rcond=None)[0]
    np.testing.assert_allclose(fitted, change.ravel(), atol=1e-4)
    at_origin, by_point = payload_columns(sarcos)
    loaded = gravity_torque(sarcos, sarcos_beta + 2.0 * (at_origin + by_point @ [0.1, 0.0, -0.05]), q)
    explained = entries["payload", None] @ (2.0, 0.2, 0.0, -0.1)
    np.testing.assert_allclose(explained, (loaded - gravity_torque(sarcos, sarcos_beta, q)).ravel(), atol=1e-10)


def test_one_pose_cannot_blame_a_payload(sarcos, sarcos_beta) -> None:
    """The payload's pattern has rank 3 at one pose: it must not win there."""
    random = np.random.default_rng(2)
    q = np.tile(random.uniform(sarcos.lower, sarcos.upper), (20, 1))
    v = gravity_torque(sarcos, sarcos_beta, q)
    payload(0.5)(sarcos, sarcos_beta, q, np.ones_like(q), v, random)
    test = CauseTest(GravityBelief(sarcos, sarcos_beta, np.zeros((14, 14))), window(q, v, q * 0))
    assert test.verdict().cause != "payload"


def test_a_vertical_joint_that_gravity_does_not_load_has_only_an_offset(sarcos, sarcos_beta) -> None:
    upright = replace(sarcos, gravity=np.array([0.0, 0.0, -9.81]))
    random = np.random.default_rng(4)
    q = random.uniform(upright.lower, upright.upper, (20, 7))
    v = gravity_torque(upright, sarcos_beta, q)
    v[:, 0] += 0.2
    v += SIGMA * random.normal(size=v.shape)
    belief = GravityBelief(upright, sarcos_beta, np.zeros((14, 14)))
    said = CauseTest(belief, window(q, v, random.choice([-1.0, 1.0], q.shape))).verdict()
    assert (said.cause, said.joint) == ("offset", 0)


def test_a_payload_whose_mass_no_lever_shows_is_a_payload() -> None:
    """All axes after the first meet in one point: only the payload's moment is felt."""
    arm = gcomp_arm(drawn_arm(220)[0])
    random = np.random.default_rng(8)
    beta = 0.5 * random.normal(size=2 * arm.n)
    q = random.uniform(arm.lower, arm.upper, (20, arm.n))
    at_origin, by_point = payload_columns(arm)
    torque = gravity_torque(arm, beta + 0.8 * (at_origin + by_point @ np.array([0.1, -0.05, 0.02])), q)
    torque += SIGMA * random.normal(size=q.shape)
    found = CauseTest(GravityBelief(arm, beta, np.zeros((2 * arm.n, 2 * arm.n))), window(q, torque, np.ones_like(q)))
    verdict = found.verdict()
    assert verdict.cause == "payload"
    assert verdict.covariance[0, 0] == 0
    assert verdict.values[1:3] == pytest.approx([0.08, -0.04], abs=0.02)


def test_a_rival_counts_for_what_its_columns_show_and_no_more() -> None:
    """A column that depends on others spans nothing, whatever its rounding points to."""
    random = np.random.default_rng(3)
    own, columns = random.normal(size=20), random.normal(size=(20, 3))
    dependent = np.column_stack([columns, columns @ [1.0, -2.0, 0.5], np.zeros(20)])
    assert span(dependent).shape == (20, 3)
    np.testing.assert_allclose(span(dependent) @ span(dependent).T, span(columns) @ span(columns).T, atol=1e-12)
    once, twice = (smallest_noticed_change(own, [(span(each), 4)], 10.0) for each in (columns, dependent))
    assert once == pytest.approx(twice, rel=1e-9)
