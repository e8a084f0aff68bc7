"""Rows and commands of 30 Hz, as LeRobot data sets have them: what happens between two rows, and whose row is whose."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from servo_arm import model_text, record, written

from sim_gap.attribution.diagnose import diagnose
from sim_gap.model.load import load_model
from sim_gap.position_gap.columns import with_columns
from sim_gap.position_gap.controller import nominal_controller, nominal_point, scales_of
from sim_gap.position_gap.identify import noise_floor
from sim_gap.position_gap.nominal_motion import own_motion, solvers
from sim_gap.position_gap.search import LoopSearch
from sim_gap.position_gap.windows import windows_of

STIFF = model_text(kp=40.0, friction=0.0, damping=0.6)
PERIOD = 0.034
READ = 2.0 * np.pi / 4096 / np.sqrt(12.0)
"""Standard deviation of a position that is read with 12 bits [rad]."""


@pytest.mark.parametrize(("rate", "least", "most"), [(100.0, 0.0, 2e-4), (1.0 / PERIOD, 3e-4, 1e-3)])
def test_what_is_missed_of_motion_between_rows_is_found_on_the_models_own(
    rate: float, least: float, most: float
) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(STIFF))
    recording = record(STIFF, 1, 20.0, rate)
    data = with_columns(windows_of(sim.arm, [recording], ["run"]))
    search = LoopSearch(data, scales_of(data), nominal_point(data, nominal_controller(sim)), np.full(2, READ))
    own = own_motion(sim, [recording], [1.0], [np.zeros(len(recording.t), bool)])
    assert np.all(own.gaps < 1.2 * READ)
    missed = own.missed(search, solvers(sim, search))
    assert least < missed.max() < most
    rough = replace(search, floor=noise_floor(data))
    floor = own.floor(rough, solvers(sim, search))
    assert np.all(floor > 0.7 * READ)
    assert np.all(floor < 1.3 * READ)
    swinging = replace(own, rougher=np.full((1, 2), 2.0))
    np.testing.assert_array_equal(swinging.floor(rough, solvers(sim, search)), rough.floor)


def test_a_recording_too_short_to_move_along_says_nothing() -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(STIFF))
    recording = record(STIFF, 1, 1.5)
    data = with_columns(windows_of(sim.arm, [record(STIFF, 1, 10.0)], ["run"]))
    search = LoopSearch(data, scales_of(data), nominal_point(data, nominal_controller(sim)), np.full(2, READ))
    own = own_motion(sim, [recording], [1.0], [np.zeros(len(recording.t), bool)])
    assert np.all(np.isinf(own.gaps))
    np.testing.assert_array_equal(own.missed(search, solvers(sim, search)), 0.0)


@pytest.mark.long
@pytest.mark.slow
def test_rows_with_the_position_of_the_next_are_told_with_their_remedy(tmp_path) -> None:
    made = []
    for seed in (1, 2):
        row = record(STIFF, seed, 14.0, 1.0 / PERIOD)
        assert row.position_command is not None
        late = {"position": row.position[1:], "position_command": row.position_command[:-1]}
        made.append(replace(row, t=row.t[:-1], **late))
    answer = diagnose(written(tmp_path, STIFF), made[:1], made[1:])
    assert {cause.effect for cause in answer.causes} == {"controller.delay"}
    for found in answer.causes[0].parameters.values():
        assert found["time"].value == pytest.approx(-PERIOD, abs=2e-3)
    (note,) = [each for each in answer.notes if each.startswith("commands take effect before the time of their rows")]
    assert note.endswith("--clock q_cmd=-0.034")


@pytest.mark.parametrize("rows", [0, 5, 25])
def test_where_hardly_a_row_is_judged_the_models_own_motion_says_nothing(rows: int) -> None:
    sim = load_model(mujoco.MjModel.from_xml_string(STIFF))
    recording = record(STIFF, 1, 4.0, 20.0)
    position = recording.position.copy()
    position[len(position) - rows :, 1] = np.nan
    apart = np.arange(len(position)) < 75 if rows != 25 else np.zeros(len(position), bool)
    own = own_motion(sim, [replace(recording, position=position)], [1.0], [apart])
    assert np.isfinite(own.gaps).all() == (rows == 25)
    assert (own.alike.size > 0) == (rows == 25)
