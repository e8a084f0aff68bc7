"""Roll-outs that begin at rest, where a command steps away at once: the servo's state then is not the new command's."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from servo_arm import search_on, weight_text

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.position_gap.fit import rms_on
from sim_gap.position_gap.plant import follow

FILTERED = '<position name="servo" joint="servo" kp="25" kv="{kv}" timeconst="{lag}" forcerange="-{limit} {limit}"/>'


def roll_out(text: str, size: float, seconds: float, slew: float = np.inf, half_s: float = 9.0) -> Recording:
    """From rest at 0 along a square wave of this size [rad], which a servo follows at `slew` [rad/s] at most."""
    model = mujoco.MjModel.from_xml_string(text)
    data, t = mujoco.MjData(model), np.arange(0.0, seconds, 0.02)
    q, command, wanted = np.empty((len(t), 1)), np.empty((len(t), 1)), 0.0
    for k, now in enumerate(t):
        q[k], command[k] = data.qpos, size * (-1.0) ** int(now / half_s)
        for _ in range(10):
            wanted += np.clip(command[k, 0] - wanted, -slew * 0.002, slew * 0.002)
            data.ctrl[:] = wanted
            mujoco.mj_step(model, data)
    return Recording(t=t, position=q, position_command=command)


@pytest.mark.parametrize("lag", [0.05, 0.3])
def test_a_models_own_steps_leave_nothing(lag: float) -> None:
    text = weight_text(0.3, 0.01, FILTERED.format(kv=2, lag=lag, limit=20)).replace(
        "<option ", '<option gravity="0 0 0" '
    )
    search = search_on(text, [roll_out(text, size, 1.0) for size in (0.4, -0.7, 1.1)])
    held_by_friction = 0.3 / 25.0
    assert rms_on(search.data, search.nominal) == pytest.approx(0.0, abs=held_by_friction)


def test_a_command_within_the_limit_of_its_change_is_followed_and_another_at_the_limit() -> None:
    random = np.random.default_rng(1128)
    given, most = np.repeat(random.normal(size=(40, 3)), 7, axis=0), np.array([0.02, 0.3, np.inf])
    last = before = random.normal(size=3)
    expected = []
    for row in given:
        last = last + np.clip(row - last, -most, most)
        expected.append(last)
    assert follow(given, before, most) == pytest.approx(np.array(expected), abs=1e-12)


@pytest.mark.long
def test_a_servo_that_limits_its_speed_is_found_from_a_model_that_filters(tmp_path: Path) -> None:
    """As published models of hobby servos do: gain and lag of the model hide the real servo's limit of speed."""
    random = np.random.default_rng(1128)
    slew, lag = random.uniform(3.0, 5.0), random.uniform(0.01, 0.03)
    real = weight_text(0.3, 0.02, FILTERED.format(kv=1, lag=lag, limit=20).replace('kp="25"', 'kp="60"'))
    sim = tmp_path / "sim.xml"
    sim.write_text(weight_text(0.1, 0.005, FILTERED.format(kv=3, lag=0.1, limit=20)), encoding="utf-8")
    shapes = [(random.uniform(0.2, 1.6), random.choice((0.25, 0.5, 9.0))) for _ in range(16)]
    runs = [roll_out(real, size * (-1) ** k, 1.5, slew, half) for k, (size, half) in enumerate(shapes)]
    found = diagnose(str(sim), runs[:10], runs[10:])
    assert (found.heldout_after < 0.2 * found.heldout_before).all()
    assert found.internals.fit.point["slew"][0] == pytest.approx(slew, rel=0.1)
