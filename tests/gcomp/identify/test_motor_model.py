"""The motor model's derivatives where several joints count in a row, at rest and in motion."""

import numpy as np
import pytest
from gravity_rig import make_random_arm

from gcomp.identify.motor_model import MotorModel, family_slices
from gcomp.identify.readings import StaticReadings


def test_derivatives_of_rows_in_which_all_joints_count() -> None:
    random = np.random.default_rng(3)
    arm, rows = make_random_arm(random, 4).arm, 6
    torque = random.normal(0.0, 5.0, (rows, arm.n))
    torque[1, 2] = np.nan
    moving = np.arange(rows)[:, None] % 2
    readings = StaticReadings(
        random.uniform(-2, 2, (rows, arm.n)),
        torque,
        np.ones(arm.n),
        load=random.uniform(0, 2, rows),
        direction=np.sign(random.normal(size=(rows, arm.n))) * (1 - moving),
        velocity=random.normal(0.0, 0.1, (rows, arm.n)) * moving,
    )
    model = MotorModel(arm, readings)
    x = random.normal(0.3, 0.2, model.size)
    x[family_slices(arm.n)["lag"]] = 0.01
    expected, jacobian = model.linearised(x)
    assert len(expected) == rows * arm.n - 1
    assert expected == pytest.approx(model.predict(x))
    for k in range(model.size):
        step = np.zeros(model.size)
        step[k] = 1e-6
        slope = (model.predict(x + step) - model.predict(x - step)) / 2e-6
        assert jacobian[:, k] == pytest.approx(slope, abs=1e-5), k
