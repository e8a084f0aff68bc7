"""Times of frames: within the interval in which they were received, and never after a later frame's."""

from hypothesis import given
from hypothesis import strategies as st

from armlink.bus.sockets.datagram_port import in_order

TIMES = st.lists(st.floats(min_value=-1e6, max_value=1e6, allow_nan=False), max_size=20)


def frames(times):
    return [(t, i, b"") for i, t in enumerate(times)]


def test_frames_that_the_kernel_did_not_stamp_yet_are_not_after_those_that_it_did():
    taken = in_order(frames([5.0, 5.0, 4.2, 4.3]), 4.0, 5.1)
    assert taken == frames([4.2, 4.2, 4.2, 4.3])


def test_a_clock_that_was_set_moves_one_batch_only():
    assert in_order(frames([104.2, 104.3]), 4.0, 5.0) == frames([5.0, 5.0])
    assert in_order(frames([4.2, -95.7]), 4.0, 5.0) == frames([4.0, 4.0])


@given(TIMES, st.floats(0.0, 1.0))
def test_times_stay_in_order_and_inside(times, length):
    taken = in_order(frames(times), 0.0, length)
    assert [frame[1:] for frame in taken] == [frame[1:] for frame in frames(times)]
    ordered = [0.0, *(t for t, _, _ in taken), length]
    assert ordered == sorted(ordered)
    for (t, _, _), late in zip(taken, times, strict=True):
        assert t <= late or t == 0.0
    if times == sorted(times):
        assert [t for t, _, _ in taken] == [min(max(t, 0.0), length) for t in times]
