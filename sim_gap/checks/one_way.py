"""Motion that goes one way: the model tells nothing of its columns."""

from collections.abc import Sequence

import numpy as np

from armlink.recording.recording import Recording

LEAST_WAY = 1.5
"""Way of the joints that move over their range (median) from which they turn back: a single stroke has 1."""
LEAST_RANGE = 0.1
"""Range from which a joint moves [rad]."""
STEP_S = 0.1
"""Time between the positions whose distances make up the way [s]: noise of closer ones would."""


def goes_one_way(recording: Recording) -> bool:
    """Whether the joints that move go to and fro less than once, or none moves.

    Then every angle and every torque is one smooth curve over time, and a wrong column, sign or zero may fit such a
    curve as well as the right one does.
    """
    t = np.arange(recording.t[0], recording.t[-1], STEP_S)
    q = np.column_stack([np.interp(t, recording.t[there := np.isfinite(x)], x[there]) for x in recording.position.T])
    span = np.ptp(q, axis=0)
    moving = span > LEAST_RANGE
    if not moving.any():
        return True
    return bool(np.median(np.abs(np.diff(q[:, moving], axis=0)).sum(0) / span[moving]) < LEAST_WAY)


def unchecked_note(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """A sentence if no recording turns back."""
    if not all(goes_one_way(recording) for recording in recordings):
        return ()
    return (
        "order, signs, zeros and clocks of the columns could not be checked: the joints move one way only, or "
        "hardly at all; record motion to and fro",
    )
