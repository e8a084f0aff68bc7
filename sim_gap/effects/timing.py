"""Readings that are delayed against the position."""

import numpy as np

from gcomp.arrays import Array
from sim_gap.effects.effect import Beneath, Effect, Plausibility, SearchHints, Shape, Signature, as_share_of_shape
from sim_gap.residuals.preprocess import Signals

SHORTEST, LONGEST = 1e-3, 0.1
"""Delays that count as such [s]."""


def late(effect_id: str, signature: Signature, start: float, longest: float) -> Effect:
    """An effect whose shape is a time: the search starts at `start` and goes up to `longest` [s]."""

    def allows(coefficients: Array, shape: Shape, _beneath: Beneath) -> bool:
        return bool(SHORTEST < coefficients[0] * shape[0] < longest)

    def relinearise(coefficients: Array, shape: Shape) -> Shape:
        return (float(np.clip(coefficients[0] * shape[0], SHORTEST, longest)),)

    return Effect(
        effect_id,
        signature,
        Plausibility(allows=allows),
        SearchHints(shapes=((start,),), linearised_at=0, relinearise=relinearise),
        parameters_of=as_share_of_shape,
    )


def _delayed(signals: Signals, joint: int, shape: Shape) -> Array:
    torque = signals.model[:, joint]
    return np.asarray(np.interp(signals.t - shape[0], signals.t, torque) - torque)


EFFECTS = (late("timing.delay", Signature.at_sensor(_delayed, "any", "distortion"), 0.005, LONGEST),)
