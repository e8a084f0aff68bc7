"""Words for people: what each effect is, and the verdict in a sentence."""

from sim_gap.attribution.diagnosis import Diagnosis

PLAIN = {
    "link.mass_moment": "the link weighs, or has its centre of mass, elsewhere than the model says",
    "link.inertia": "the link is harder or easier to swing than the model says",
    "link.payload": "something is attached to the tip that the model does not have",
    "base.tilt": "the base is not level as the model has it",
    "position.offset": "the position sensor reads a constant angle off",
    "position.gain": "the position sensor's angles are scaled",
    "position.eccentricity": "the position sensor errs once a turn",
    "torque.offset": "the torque reading is a constant off",
    "torque.gain": "the torque reading is scaled",
    "torque.drift": "the torque reading drifts with time",
    "torque.crosstalk": "the torque reading follows another joint's torque",
    "torque.hysteresis": "the torque reading lags behind a change of direction of the torque",
    "torque.deadband": "small torques do not show in the reading",
    "torque.saturation": "the torque reading is clipped",
    "timing.delay": "the torque reading comes late",
    "friction.coulomb": "dry friction, the same at every speed",
    "friction.viscous": "friction in proportion to the speed",
    "friction.stribeck": "more friction at creeping speed",
    "friction.asymmetric": "more friction one way than the other",
    "friction.load": "friction in proportion to the torque carried",
    "transmission.ripple": "torque that varies with the position of the gear's teeth",
    "transmission.spring": "a spring across the joint, such as a cable bundle",
    "transmission.elasticity": "the transmission gives under torque",
    "transmission.backlash": "the transmission has play",
    "transmission.coupling": "the motor turns with another joint as well",
    "actuator.gain": "the motor's torque constant is not what the drive believes",
    "actuator.rotor_inertia": "the motor's rotor, missing in the model",
    "actuator.lag": "the motor follows its command with a lag",
    "actuator.delay": "the motor follows its command late",
    "actuator.saturation": "the motor's torque is clipped",
}


def sentence(answer: Diagnosis) -> str:
    """The verdict in a sentence, without a full stop."""
    if answer.verdict == "no_gap":
        return (
            "nothing exceeds twice the noise floor by a margin worth caring about (1.6 % of the joint's usual torque)"
        )
    if answer.verdict == "unexplained" and answer.unexplained < 0.01 and answer.notes:
        return answer.notes[0]
    if answer.verdict == "unexplained":
        return f"{answer.unexplained:.0%} of the gap is left that no effect of the library accounts for"
    first = answer.causes[0]
    if answer.verdict == "ambiguous":
        rivals = " or ".join(first.confounded_with)
        return f"{first.effect} explains it, and so would {rivals}; this recording cannot tell: {first.separate_by}"
    share = f"{1.0 - answer.unexplained:.0%}"
    return f"{share} of the gap is accounted for on motion that was not fitted, most of all by {first.effect}"
