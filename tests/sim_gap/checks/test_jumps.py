"""Jumps of positions: pieces put together are told from slow recordings, from turns lost, and from sound motion."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from armlink.recording.corrections import AS_IT_IS, parse_corrections
from armlink.recording.recording import Recording
from sim_gap.checks.positions import find_jumps, find_seam, unwrap


def of_position(position: np.ndarray, rate: float) -> Recording:
    q = np.asarray(position, float)[:, None]
    return Recording(t=np.arange(len(q)) / rate, position=q, torque=np.zeros_like(q))


def at_rest_between(moves: int, rate: float = 10.0) -> Recording:
    """Ten minutes in poses that are 0.3 rad apart, each reached within half a second."""
    t = np.arange(0.0, 600.0, 1.0 / rate)
    ramps = [np.clip((t - 600.0 * (k + 0.5) / moves) / 0.5, 0.0, 1.0) for k in range(moves)]
    return of_position(0.3 * np.sum(ramps, axis=0), rate)


@pytest.mark.parametrize("moves", [1, 3, 10])
def test_an_arm_that_rests_and_moves_now_and_then_does_not_jump(moves):
    assert find_jumps(at_rest_between(moves), AS_IT_IS) is None


def test_poses_put_together_jump():
    """At rest in either: nothing but the jump is a motion."""
    finding = find_jumps(of_position(np.repeat([0.0, 0.3], 500), 100.0), AS_IT_IS)
    assert finding.finding == "dropped"
    assert "jumps by 0.30 rad" in finding.evidence
    assert find_jumps(of_position(np.repeat([0.0, 0.3], 500), 100.0), parse_corrections(clock=["t=0"])) is None


@pytest.mark.parametrize("turn", [2.0 * np.pi, 360.0])
def test_positions_wrap_in_radians_and_in_degrees(turn):
    far = turn * np.linspace(-0.7, 1.6, 2000)
    recording = of_position((far + 0.5 * turn) % turn - 0.5 * turn, 100.0)
    corrected, (finding,) = unwrap(recording)
    assert (finding.finding, finding.corrected) == ("zero", True)
    np.testing.assert_allclose(np.diff(corrected.position[:, 0]), np.diff(far), atol=1e-9 * turn)
    assert find_jumps(corrected, AS_IT_IS) is None


@pytest.fixture(scope="module")
def slow() -> Recording:
    """Thirty rows a second with their velocities, noise on both."""
    made = record(model(), Wrong(), seconds=40.0, rate=30.0)
    random = np.random.default_rng(3)
    velocity = np.gradient(made.position, made.t, axis=0)
    return replace(
        made,
        position=made.position + 3e-4 * random.normal(size=velocity.shape),
        velocity=velocity + 0.01 * random.normal(size=velocity.shape),
    )


def without(recording: Recording, first: int, last: int) -> Recording:
    """The recording less some rows, on a clock that does not show it."""
    kept = np.r_[0:first, last : recording.t.size]
    channels = {name: values[kept] for name, values in recording.channels().items()}
    return replace(recording, **channels, t=recording.t[: kept.size])


def test_pieces_whose_ends_are_near_meet_at_a_seam(slow):
    """The piece that is lost is short, and no joint goes far in it."""
    assert find_seam(slow, AS_IT_IS) is None
    pieces = without(slow, 600, 609)
    assert find_jumps(pieces, AS_IT_IS) is None
    finding = find_seam(pieces, AS_IT_IS)
    assert finding.finding == "dropped"
    assert "t = 20.0" in finding.evidence
    assert find_seam(pieces, parse_corrections(clock=["t=0"])) is None


def test_a_stop_from_one_row_to_the_next_is_no_seam(slow):
    """Velocities jump, and positions go no farther than those before and after let them."""
    stops = without(slow, slow.t.size - 1, slow.t.size)
    for channel, value in (("position", slow.position[600]), ("velocity", np.zeros(3))):
        values = getattr(stops, channel).copy()
        values[601:] = value
        stops = replace(stops, **{channel: values})
    assert find_seam(stops, AS_IT_IS) is None


def test_a_single_row_that_is_missing_is_no_seam(slow):
    assert find_seam(without(slow, 600, 601), AS_IT_IS) is None


def test_without_velocities_no_seam_is_looked_for(slow):
    assert find_seam(replace(without(slow, 600, 609), velocity=None), AS_IT_IS) is None
