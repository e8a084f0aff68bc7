"""Beside the comparison: lines and resonances above the pass band."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.signal import lfilter
from wrong_arms import Wrong, model, record

from armlink.recording.recording import Recording
from sim_gap.model.load import load_model
from sim_gap.residuals.disregarded_rows import fast_gaps
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet

RATE = 250.0


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(model(), Wrong(), seed=1, seconds=20.0, rate=RATE)


def places(recording: Recording, more: np.ndarray):
    """Locations above the band, with a torque added to joint 2's sensor."""
    torque = recording.torque.copy()
    torque[:, 1] += more
    made = replace(recording, torque=torque)
    signals = prepare(made, load_model(model()).arm)
    return fast_gaps(ResidualSet((signals,), layout_of([signals])), [made])


def ringing(count: int, hertz: float, damping: float) -> np.ndarray:
    """Noise through a lightly damped mode, RMS 0.6."""
    pole = np.exp((-damping + 1j * np.sqrt(1.0 - damping**2)) * 2.0 * np.pi * hertz / RATE)
    ring = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], np.random.default_rng(3).normal(size=count))
    return 0.6 * ring / ring.std()


@pytest.mark.parametrize(("hertz", "damping"), [(11.0, 0.02), (32.0, 0.04), (40.0, 0.05)])
def test_a_resonance_is_told_though_it_is_no_sharp_line(recording, hertz, damping):
    (place,) = places(recording, ringing(len(recording.t), hertz, damping))
    assert (place.joint, place.channel, place.regime) == ("joint_2", "tau", "band")
    assert place.hz == pytest.approx(hertz, rel=0.1)
    assert place.rms == pytest.approx(0.6, rel=0.25)


def test_a_line_keeps_its_frequency(recording):
    (place,) = places(recording, 0.5 * np.sin(2.0 * np.pi * 33.3 * recording.t))
    assert place.hz == pytest.approx(33.3, abs=0.3)
    assert place.rms == pytest.approx(0.5 / np.sqrt(2.0), rel=0.1)


@pytest.mark.parametrize("order", ["white", "rising", "falling"])
def test_noise_without_a_peak_is_none(recording, order):
    """Noise of a derivative rises with frequency, that of a low pass falls."""
    noise = np.random.default_rng(5).normal(size=len(recording.t))
    forms = {"white": ([1.0], [1.0]), "rising": ([1.0, -0.95], [1.0]), "falling": ([1.0], [1.0, -0.8])}
    assert places(recording, 0.5 * lfilter(*forms[order], noise)) == []


def rung(recording: Recording, noise: float = 0.0) -> Recording:
    """Joint 2 swings at 12 Hz, and the torques are what MuJoCo's mass matrix asks for."""
    arm, swing = model(), 2.0 * np.pi * 12.0
    data, inertia = mujoco.MjData(arm), np.zeros((len(recording.t), arm.nv))
    for row, q in zip(inertia, recording.position, strict=True):
        data.qpos[:] = q
        mujoco.mj_fwdPosition(arm, data)
        whole = np.zeros((arm.nv, arm.nv))
        mujoco.mj_fullM(arm, data, whole)
        row[:] = whole[1]
    size = 0.6 * np.sqrt(2.0) / (inertia[:, 1].mean() * swing**2)
    line = size * np.sin(swing * recording.t)
    position = recording.position + noise * np.random.default_rng(7).normal(size=recording.position.shape)
    position[:, 1] += line
    return replace(recording, position=position, torque=recording.torque - swing**2 * line[:, None] * inertia)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_what_the_arm_moves_by_is_no_gap(recording, noise):
    made = rung(recording, noise)
    assert places(made, np.zeros(len(made.t))) == []
    assert places(replace(made, position=recording.position), np.zeros(len(made.t)))


def test_what_the_arm_moves_by_hides_no_weaker_line(recording):
    (place,) = places(rung(recording), 0.4 * np.sin(2.0 * np.pi * 33.3 * recording.t))
    assert place.joint == "joint_2"
    assert place.hz == pytest.approx(33.3, abs=0.3)
