"""How fast a joint creeps in MuJoCo under half its friction, against what is said of its solver parameters."""

import mujoco
import numpy as np
import pytest

from sim_gap.model.solver_friction import creep_speeds, solver_parameters

FRICTION = 0.6


def model(inertia: float, solver: str = "", step: float = 0.002) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 0 1"
        frictionloss="{FRICTION}" armature="{inertia}" {solver}/>
        <inertial pos="0 0 0" mass="0.1" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody></mujoco>"""
    )


def speed_under(arm: mujoco.MjModel, torque: float) -> float:
    data = mujoco.MjData(arm)
    data.qfrc_applied[0] = torque
    mujoco.mj_step(arm, data, round(0.5 / arm.opt.timestep))
    return float(data.qvel[0])


@pytest.mark.parametrize("inertia", [0.005, 0.1])
@pytest.mark.parametrize(
    ("solver", "step"),
    [
        ("", 0.002),
        ("", 0.015),  # MuJoCo keeps the time constant above two steps
        ('solimpfriction="0.99 0.999 0.001 0.5 2" solreffriction="0.05 1"', 0.002),
        ('solreffriction="-100 -40"', 0.002),
        ('solimpfriction="0.999 0.9999 0.001 0.5 2" solreffriction="0.01 1"', 0.002),
    ],
)
def test_half_the_friction_makes_half_the_creep(inertia: float, solver: str, step: float) -> None:
    arm = model(inertia, solver, step)
    (speed,) = creep_speeds(arm, [0])
    assert speed_under(arm, 0.5 * FRICTION) == pytest.approx(0.5 * speed, rel=0.02)


@pytest.mark.parametrize("speed", [0.002, 0.02, 0.1])
@pytest.mark.parametrize("inertia", [0.005, 0.1])
def test_a_joint_is_written_to_creep_as_asked(inertia: float, speed: float) -> None:
    weight = float(model(inertia).dof_invweight0[0])
    (time, ratio), solimp = solver_parameters(FRICTION, speed, weight)
    text = f'solreffriction="{time} {ratio}" solimpfriction="{" ".join(map(str, solimp))}"'
    arm = model(inertia, text)
    least = creep_speeds(model(inertia, 'solreffriction="0.01 1" solimpfriction="0.999 0.9999 0.001 0.5 2"'), [0])[0]
    assert speed_under(arm, 0.5 * FRICTION) == pytest.approx(0.5 * max(speed, least), rel=0.02)


def test_a_joint_without_creep_or_friction_rests() -> None:
    assert solver_parameters(FRICTION, 0.0, 10.0) == solver_parameters(0.0, 0.0, 10.0)
    assert solver_parameters(FRICTION, 0.0, 10.0) == ([0.01, 1.0], [0.999, 0.9999, 0.001, 0.5, 2.0])
    assert np.all(creep_speeds(mujoco.MjModel.from_xml_string(FREE), [0]) == 0.0)


FREE = """<mujoco><worldbody><body><joint axis="0 0 1"/><geom size="0.1"/></body></worldbody></mujoco>"""
