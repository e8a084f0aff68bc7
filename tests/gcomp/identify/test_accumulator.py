"""Normal equations in blocks: the same answer as the QR of everything, in bounded memory, and as FIGAROH's residual."""

import tracemalloc

import numpy as np
import pytest
from gravity_rig import DOWN, SARCOS_BETA, make_readings, make_sarcos

from gcomp.errors import BadArray
from gcomp.gravity.torque import gravity_torque
from gcomp.identify.accumulator import MomentAccumulator
from gcomp.identify.global_fit import identify_global
from gcomp.identify.parameters import Parameters

SIGMA = np.array([0.15, 0.15, 0.08, 0.06, 0.03, 0.03, 0.02])
OFFSET = np.linspace(-1, 1, 7)
TRUE = Parameters.nominal(7, beta=SARCOS_BETA, offset=OFFSET)


def test_blocks_give_what_the_global_fit_gives(sarcos, rng) -> None:
    q = rng.uniform(sarcos.lower, sarcos.upper, (9000, 7))
    marks = np.where(rng.random(q.shape) < 0.2, np.nan, 0.0)
    rows = make_readings(sarcos, TRUE, q, marks, sigma=SIGMA, rng=rng)
    accumulator = MomentAccumulator(sarcos, SIGMA)
    for begin in range(0, 9000, 1700):
        accumulator.add(rows.position[begin : begin + 1700], rows.torque[begin : begin + 1700])
    found, expected = accumulator.solve(), identify_global(sarcos, rows, unknown=("offset", "beta"))
    assert found.names == expected.names
    assert found.beta == pytest.approx(expected.values.beta, abs=1e-10)
    assert found.offset == pytest.approx(expected.values.offset, abs=1e-9)
    assert found.covariance == pytest.approx(expected.covariance, rel=1e-6)
    rms = np.sqrt(np.nanmean(expected.residual**2, axis=0))
    assert found.residual_rms == pytest.approx(rms, rel=1e-6)
    assert found.samples == 9000


def test_without_noise_it_is_exact(sarcos, rng) -> None:
    q = rng.uniform(sarcos.lower, sarcos.upper, (500, 7))
    accumulator = MomentAccumulator(sarcos, 0.05)
    accumulator.add(q, gravity_torque(sarcos, SARCOS_BETA, q) + OFFSET)
    found = accumulator.solve()
    assert found.beta == pytest.approx(SARCOS_BETA, abs=1e-9)
    assert found.offset == pytest.approx(OFFSET, abs=1e-9)


def test_vertical_joint_is_listed(rng) -> None:
    arm = make_sarcos(DOWN)
    q = rng.uniform(arm.lower, arm.upper, (500, 7))
    accumulator = MomentAccumulator(arm, 0.05)
    accumulator.add(q, gravity_torque(arm, SARCOS_BETA, q))
    found = accumulator.solve()
    assert np.isnan(found.beta[:2]).all()
    assert found.beta[2:] == pytest.approx(SARCOS_BETA[2:], abs=1e-9)
    assert len(found.null_space) == 2


def test_peak_memory_does_not_grow_with_the_samples(sarcos, rng) -> None:
    """10,000 samples under 200 MB above the interpreter; a million need no more."""
    q = rng.uniform(sarcos.lower, sarcos.upper, (10_000, 7))
    torque = gravity_torque(sarcos, SARCOS_BETA, q)
    peaks = []
    for repeats in (1, 100):
        accumulator = MomentAccumulator(sarcos, 0.05)
        tracemalloc.start()
        for _ in range(repeats):
            accumulator.add(q, torque)
        accumulator.solve()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[0] < 50e6
    assert peaks[1] < 1.1 * peaks[0]


def test_global_fit_of_ten_thousand_samples_stays_in_bounded_memory(sarcos, rng) -> None:
    q = rng.uniform(sarcos.lower, sarcos.upper, (10_000, 7))
    rows = make_readings(sarcos, TRUE, q, np.zeros_like(q), sigma=SIGMA)
    tracemalloc.start()
    identify_global(sarcos, rows, unknown=("offset", "beta"))
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def test_nothing_to_fit_is_said(sarcos) -> None:
    with pytest.raises(BadArray, match="no torque reading counts"):
        MomentAccumulator(sarcos, 0.05).solve()
    with pytest.raises(BadArray, match=r"position has shape \(4, 6\)"):
        MomentAccumulator(sarcos, 0.05).add(np.zeros((4, 6)), np.zeros((4, 6)))
