"""Whether recordings move as MuJoCo's solver moves the model: of the same arm, with the model's step and a fine one."""

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record

from sim_gap.model.load import SimModel, load_model
from sim_gap.position_gap.columns import with_columns
from sim_gap.position_gap.controller import nominal_controller, nominal_point, scales_of
from sim_gap.position_gap.fit import LoopFit, evaluate, improve
from sim_gap.position_gap.judge import joint_rms
from sim_gap.position_gap.nominal_motion import nominal_solver, other_solver, solvers
from sim_gap.position_gap.search import LoopSearch
from sim_gap.position_gap.windows import windows_of

STEP = 0.004


def arm(step: float = STEP, method: str = "Euler", servo: float = 0.6) -> str:
    """The arm with servos that damp, and friction as MuJoCo's usual solver parameters make it."""
    text = model_text(kp=40.0, friction=0.15, damping=0.2, creeps=True)
    text = text.replace('timestep="0.002" integrator="implicitfast"', f'timestep="{step}" integrator="{method}"')
    return text.replace('kp="40.0"', f'kp="40.0" kv="{servo}"')


def search_on(text: str, nominal: str) -> tuple[SimModel, LoopSearch]:
    """What the effects compete on: a recording of an arm, beside a model."""
    sim = load_model(mujoco.MjModel.from_xml_string(nominal))
    data = with_columns(windows_of(sim.arm, [record(text, 1, 20.0)], ["run"]))
    return sim, LoopSearch(data, scales_of(data), nominal_point(data, nominal_controller(sim)), np.full(2, 5e-4))


def left(search: LoopSearch) -> np.ndarray:
    fit = evaluate(search.data, LoopFit(search.nominal, ((), ())))
    assert fit.rms is not None
    return joint_rms(search.data, fit.rms)


@pytest.mark.parametrize("method", ["Euler", "implicitfast"])
def test_a_recording_of_the_model_itself_leaves_what_it_was_read_with(method: str) -> None:
    sim, search = search_on(arm(method=method), arm(method=method))
    found = nominal_solver(search, solvers(sim, search))
    assert np.all(found.nominal["early"] == 0.5 * STEP)
    assert np.all(found.nominal["servo_late"] == (STEP if method == "Euler" else 0.0))
    assert np.all(found.nominal["creep"] > 0.0)
    assert (left(search) > 3.0 * left(found)).all()
    assert (left(found) < 6e-4).all()  # 4.4e-4 are the encoder's


def test_an_arm_that_no_step_moves_has_nothing_of_a_solver() -> None:
    fine = arm(step=0.0001)
    sticks = 'solreffriction="0.001 1" solimpfriction="0.9999 0.9999 0.001 0.5 2" frictionloss'
    sim, search = search_on(fine.replace("frictionloss", sticks), arm())
    found = nominal_solver(search, solvers(sim, search))
    assert all(np.all(found.nominal[name] == 0.0) for name in ("early", "servo_late", "creep"))


def test_where_a_solver_does_nothing_there_is_none_to_choose() -> None:
    """Runge-Kutta without friction ended in an empty minimum where all values were alike."""
    sim, search = search_on(arm(), arm(method="RK4").replace('frictionloss="0.15"', ""))
    kinds = solvers(sim, search)
    assert len(kinds) == 1
    search = nominal_solver(search, kinds)
    assert other_solver(search, evaluate(search.data, LoopFit(search.nominal, ((), ()))), kinds) is None
    sim, search = search_on(arm(), arm().replace('frictionloss="0.15"', ""))
    assert len(solvers(sim, search)) == 2


@pytest.mark.long
def test_delay_and_inertia_that_stand_for_a_solver_are_seen_to() -> None:
    sim, search = search_on(arm(), arm())
    kinds = solvers(sim, search)
    search = nominal_solver(search, kinds[:1])
    own = ("delay", "armature", "coulomb")
    fit = improve(search.data, LoopFit(search.nominal, (own, own)), search.scales, 8)
    solver = other_solver(search, fit, kinds)
    assert solver is not None
    assert np.all(solver["early"] == 0.5 * STEP)
