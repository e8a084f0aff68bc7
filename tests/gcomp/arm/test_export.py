"""Feasible inertials: exact mass moments, bounds kept, nearest; and written back into URDF and MJCF."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from gravity_rig import make_random_arm
from published_arms import MJCF, PANDA, mujoco_torque, urdf
from scipy.optimize import minimize

from gcomp.arm.export import write_model
from gcomp.arm.feasible_inertials import (
    Bounds,
    Inertials,
    NotFeasible,
    least_distance,
    nearest_inertials,
)
from gcomp.arm.load import load_model
from gcomp.arm.mass_moments import base_parameters
from gcomp.errors import BadModel
from gcomp.gravity.torque import gravity_torque

J2 = '<joint name="j2" class="j" axis="0 1 1"/>'


@pytest.mark.parametrize("suffix", ["urdf", "xml"])
def test_written_model_has_the_identified_gravity_torque(suffix: str, tmp_path: Path, rng) -> None:
    source, target = tmp_path / f"arm.{suffix}", tmp_path / f"identified.{suffix}"
    source.write_text(urdf(PANDA, (0.1, 0.2, 0.3)) if suffix == "urdf" else MJCF.replace(J2, ""))
    model = load_model(source)
    beta = model.beta + 0.05 * rng.normal(size=len(model.beta))
    changes = write_model(source, target, beta)
    q = rng.uniform(-2, 2, (50, model.arm.n))
    if suffix == "urdf":
        written = pin.buildModelFromUrdf(str(target))
        data = written.createData()
        found = np.array([pin.computeGeneralizedGravity(written, data, row) for row in q])
    else:
        found = mujoco_torque(target, q)
    assert np.abs(found - gravity_torque(model.arm, beta, q)).max() < 1e-8
    assert all(change.mass_after >= 0.1 * change.mass_before for change in changes)
    assert [change.joint for change in changes] == list(model.arm.names)
    assert 0 < max(change.moved for change in changes) < 0.3


def test_unchanged_moments_change_nothing(tmp_path: Path) -> None:
    source = tmp_path / "arm.urdf"
    source.write_text(urdf(PANDA))
    for change in write_model(source, tmp_path / "same.urdf", load_model(source).beta):
        assert change.moved < 1e-9
        assert change.mass_after == pytest.approx(change.mass_before)


def test_moments_that_gravity_cannot_see_stay_free(tmp_path: Path) -> None:
    source = tmp_path / "arm.urdf"
    source.write_text(urdf(PANDA))
    beta = load_model(source).beta.copy()
    beta[:2] = np.nan
    beta[5] += 0.02
    write_model(source, tmp_path / "new.urdf", beta)
    assert load_model(tmp_path / "new.urdf").beta[2:] == pytest.approx(beta[2:], abs=1e-9)


def test_a_joint_without_a_body_of_its_own_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "arm.xml"
    source.write_text(MJCF)
    with pytest.raises(BadModel, match="joint j2 moves no mass of its own"):
        write_model(source, tmp_path / "new.xml", load_model(source).beta)


def test_nearest_inertials_are_nearest_and_keep_the_bounds(rng) -> None:
    """Against a general optimiser on the same convex problem."""
    built = make_random_arm(rng, 3)
    nominal = Inertials(built.mass, built.first_moment)
    beta = built.beta + 0.3 * rng.normal(size=6)
    box = np.full((3, 3), 0.25)
    bounds = Bounds(0.2 * built.mass, nominal.com - box, nominal.com + box)

    def moments(mass, moment):
        return base_parameters(built.arm, mass, moment)

    found = nearest_inertials(beta, nominal, bounds, moments)
    assert moments(found.mass, found.first_moment) == pytest.approx(beta, abs=1e-9)
    assert np.all(found.mass >= 0.2 * built.mass - 1e-9)
    assert np.all(np.abs(found.com - nominal.com) <= 0.25 + 1e-7)

    def distance(x):
        each = x.reshape(3, 4)
        moved = np.column_stack([each[:, 0] - nominal.mass, (each[:, 1:] - nominal.first_moment) / 0.1])
        return np.sum((moved / nominal.mass[:, None]) ** 2)

    rows, limits = bounds.rows()
    other = minimize(
        distance,
        np.column_stack([nominal.mass, nominal.first_moment]).ravel(),
        method="SLSQP",
        constraints=[
            {"type": "eq", "fun": lambda x: moments(x.reshape(3, 4)[:, 0], x.reshape(3, 4)[:, 1:]) - beta},
            {"type": "ineq", "fun": lambda x: rows @ x - limits},
        ],
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert other.success
    ours = distance(np.column_stack([found.mass, found.first_moment]).ravel())
    assert ours == pytest.approx(other.fun, rel=1e-4)


def test_bounds_that_leave_nothing_are_said_to(rng) -> None:
    built = make_random_arm(rng, 3)
    nominal = Inertials(built.mass, built.first_moment)
    tight = Bounds(built.mass, nominal.com - 1e-3, nominal.com + 1e-3)
    with pytest.raises(NotFeasible, match="no masses above their bounds"):
        nearest_inertials(built.beta + 100 * np.ones(6), nominal, tight, lambda m, s: base_parameters(built.arm, m, s))


def test_least_distance_solves_the_textbook_case() -> None:
    """Shortest u with u_1 + u_2 ≥ 2 and u_1 ≥ 1.5 is (1.5, 0.5); with u_1 ≥ 1 and −u_1 ≥ 0 there is none."""
    assert least_distance(np.array([[1.0, 1], [1, 0]]), np.array([2, 1.5])) == pytest.approx([1.5, 0.5])
    assert least_distance(np.array([[1.0, 0], [-1, 0]]), np.array([1.0, 0])) is None
