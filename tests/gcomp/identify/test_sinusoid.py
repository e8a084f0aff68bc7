"""The single-joint fit against the precision and friction tables of docs/theory.md, section 5, and by Monte Carlo."""

import numpy as np
import pytest

from gcomp.errors import BadArray
from gcomp.identify.sinusoid import fit_sinusoid

STEPS, A = 721, 20.0
ZERO_CROSSING = {  # range °: (s_A, s_Φ, s_o) in σ/√K, centred on a zero crossing; Φ also times A
    360: (1.41, 1.41, 1.00), 300: (1.31, 1.62, 1.05), 270: (1.28, 1.81, 1.14), 180: (1.41, 3.24, 2.29),
    120: (1.84, 6.60, 5.55), 90: (2.34, 11.3, 10.3), 60: (3.40, 24.9, 23.8),
}  # fmt: skip
PEAK = {
    360: (1.41, 1.41, 1.00), 300: (1.62, 1.31, 1.05), 270: (1.81, 1.28, 1.14), 180: (3.24, 1.41, 2.29),
    120: (6.60, 1.84, 5.55), 90: (11.3, 2.34, 10.3), 60: (24.9, 3.40, 23.8),
}  # fmt: skip
GAIN_UNKNOWN = {  # (s_A zero crossing, peak, s_c zero crossing, peak)
    360: (1.46, 1.71, 0.75, 1.9), 300: (1.36, 4.0, 1.2, 3.8), 270: (1.29, 6.8, 1.6, 5.6), 180: (2.97, 44, 5.2, 27),
    120: (13.7, 245, 17, 133), 90: (36, 796, 41, 417), 60: (131, 4108, 138, 2095),
}  # fmt: skip


def swept(degrees: float, steps: int = STEPS) -> np.ndarray:
    half = np.deg2rad(degrees) / 2
    return np.linspace(-half, half, steps, endpoint=degrees < 360)


@pytest.mark.parametrize("degrees", ZERO_CROSSING)
@pytest.mark.parametrize(("phase", "table"), [(0.0, ZERO_CROSSING), (np.pi / 2, PEAK)])
def test_precision_by_range(degrees: int, phase: float, table: dict[int, tuple[float, ...]]) -> None:
    phi = swept(degrees)
    fit = fit_sinusoid(phi, A * np.sin(phi + phase) + 1.5, np.sqrt(len(phi)))
    assert (fit.amplitude, fit.phase, fit.offset) == pytest.approx((A, phase, 1.5), abs=1e-9)
    found = fit.std("amplitude"), A * fit.std("phase"), fit.std("offset")
    assert found == pytest.approx(table[degrees], rel=0.05)


@pytest.mark.parametrize("degrees", GAIN_UNKNOWN)
def test_precision_with_the_position_gain_unknown(degrees: int) -> None:
    phi, found = swept(degrees), []
    for phase in (0.0, np.pi / 2):
        fit = fit_sinusoid(phi, A * np.sin(1.0137 * phi + phase) + 1.5, np.sqrt(len(phi)), fit_position_gain=True)
        assert fit.position_gain == pytest.approx(1.0137, abs=1e-6)  # between two of those that are tried first
        found += [fit.std("amplitude"), A * fit.std("position_gain")]
    s_a, s_a_peak, s_c, s_c_peak = GAIN_UNKNOWN[degrees]
    near = fit_sinusoid(phi, A * np.sin(phi) + 1.5, np.sqrt(len(phi)), fit_position_gain=True)
    peak = fit_sinusoid(phi, A * np.cos(phi) + 1.5, np.sqrt(len(phi)), fit_position_gain=True)
    assert (near.std("amplitude"), A * near.std("position_gain")) == pytest.approx((s_a, s_c), rel=0.05)
    assert (peak.std("amplitude"), A * peak.std("position_gain")) == pytest.approx((s_a_peak, s_c_peak), rel=0.05)
    assert np.isfinite(found).all()


def test_intervals_hold_what_they_promise(rng) -> None:
    """Monte Carlo: 95 % intervals of amplitude, offset and position gain cover the truth 95 % of the time."""
    phi, sigma, inside = swept(300, 37), 0.05, []
    for _ in range(400):
        v = 3 * np.sin(1.02 * phi + 0.4) + 0.2 + sigma * rng.normal(size=len(phi))
        fit = fit_sinusoid(phi, v, sigma, fit_position_gain=True)
        error = fit.amplitude - 3, fit.phase - 0.4, fit.offset - 0.2, fit.position_gain - 1.02
        inside.append(np.abs(error) < 1.96 * np.sqrt(np.diag(fit.covariance)))
    assert np.mean(inside, axis=0) == pytest.approx(np.full(4, 0.95), abs=0.035)


BOTH = np.concatenate([swept(360, 36), swept(360, 36)])
SIDE = np.repeat([1.0, -1.0], 36)


def test_constant_friction_is_an_offset_from_one_side_and_nothing_from_both() -> None:
    torque = A * np.sin(BOTH)
    one = fit_sinusoid(BOTH[:36], torque[:36] + 0.5, 0.05)
    assert (one.offset, one.amplitude) == pytest.approx((0.5, A), abs=1e-9)
    both = fit_sinusoid(BOTH, torque + 0.5 * SIDE, 0.05, direction=SIDE)
    assert (both.offset, both.amplitude, both.friction) == pytest.approx((0, A, 0.5), abs=1e-9)


def test_load_dependent_friction_biases_as_the_note_says() -> None:
    """μ_f = 0.03: one direction gives an offset of 2 μ_f A/π over a turn, a gain where the torque keeps its sign."""
    torque = A * np.sin(BOTH[:36])
    assert fit_sinusoid(BOTH[:36], torque + 0.03 * np.abs(torque), 0.05).offset == pytest.approx(0.37, abs=0.02)
    phi = swept(160, 37)
    kept = A * np.cos(phi)
    assert fit_sinusoid(phi, kept + 0.03 * np.abs(kept), 0.05).amplitude == pytest.approx(1.03 * A, rel=1e-6)
    half = swept(180, 37)
    crossing = A * np.sin(half)
    biased = fit_sinusoid(half, crossing + 0.03 * np.abs(crossing), 0.05)
    assert (biased.offset, biased.phase) == pytest.approx(
        (0.72, -0.026), abs=0.006
    )  # 37 steps: 0.715; 361 steps: 0.731


def test_what_averaging_both_directions_leaves() -> None:
    """Asymmetric friction leaves an offset, stiction that gravity releases a gain of (2/π) Δρ f_c/A."""
    torque = A * np.sin(BOTH)
    lopsided = np.where(SIDE > 0, 0.55, -0.45)
    assert fit_sinusoid(BOTH[:36], torque[:36] + 0.55, 0.05).offset == pytest.approx(0.55)
    assert fit_sinusoid(BOTH, torque + lopsided, 0.05, direction=SIDE).offset == pytest.approx(0.05)
    locked = np.where(np.sign(torque) == SIDE, 1.0, 0.6) * 0.5 * SIDE
    assert fit_sinusoid(BOTH, torque + locked, 0.05, direction=SIDE).amplitude / A == pytest.approx(1.0064, abs=2e-4)


def test_unequal_stop_angles_do_not_matter_with_the_friction_column(rng) -> None:
    phi = np.sort(rng.uniform(-2, 2, 60))
    side = np.where(rng.random(60) < 0.5, 1.0, -1.0)
    fit = fit_sinusoid(phi, 5 * np.sin(phi + 0.3) + 0.7 + 0.4 * side, 0.05, direction=side)
    assert (fit.amplitude, fit.phase, fit.offset, fit.friction) == pytest.approx((5, 0.3, 0.7, 0.4), abs=1e-9)


def test_too_few_steps_are_refused() -> None:
    with pytest.raises(BadArray, match=r"2 steps over 1.000 rad do not determine amplitude, phase, offset"):
        fit_sinusoid([0, 1.0], [0, 1.0], 0.05)
