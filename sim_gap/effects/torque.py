"""Linear errors of a joint torque sensor: they show in `tau` against the model, and negated in motor against `tau`."""

import numpy as np

from sim_gap.effects.effect import Effect, Plausibility, Signature, as_gain, between

EFFECTS = (
    Effect(  # without a sensor, an offset of the motor's torque
        "torque.offset",
        Signature.at_sensor(lambda s, _joint, _shape: np.ones(len(s.t)), "any"),
        Plausibility(prior_penalty=0, background_std=0.02, background_nm=True),
    ),
    Effect(
        "torque.gain",
        Signature.at_sensor(lambda s, joint, _shape: s.sensed[:, joint]),
        Plausibility(prior_penalty=0, background_std=0.002, allows=between(-0.5, 1.0)),
        parameters_of=as_gain,
    ),
    Effect("torque.drift", Signature.at_sensor(lambda s, _joint, _shape: s.t), needs=("torque.offset",)),
)
