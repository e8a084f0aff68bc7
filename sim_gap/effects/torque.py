"""Linear errors of a joint torque sensor: they show in `tau` against the model, and negated in motor against `tau`."""

import numpy as np

from sim_gap.effects.effect import Effect, Plausibility, any_channel, as_gain, at_sensor, between

EFFECTS = (
    Effect(  # without a sensor, an offset of the motor's torque
        "torque.offset",
        at_sensor(lambda s, _joint, _shape: np.ones(len(s.t)), any_channel),
        Plausibility(prior_penalty=0, background_std=0.02),
    ),
    Effect(
        "torque.gain",
        at_sensor(lambda s, joint, _shape: s.model[:, joint]),
        Plausibility(prior_penalty=0, background_std=0.002, allows=between(-0.5, 1.0)),
        parameters_of=as_gain,
    ),
    Effect("torque.drift", at_sensor(lambda s, _joint, _shape: s.t), needs=("torque.offset",)),
)
