"""The verdict of a diagnosis in a sentence, and its parameters in rows."""

from sim_gap.attribution.diagnosis import HINT, Cause, Diagnosis

WORDS = {"explained": "explained", "ambiguous": "ambiguous", "unexplained": "not explained", "no_gap": "no gap"}
"""Verdicts as a heading."""
CHANNEL_WORDS = {"tau": "torque sensor", "tau_motor": "motor torque", "tau_cmd": "commanded torque"}
"""Torque channels of a recording, for people."""


def advice(answer: Diagnosis) -> str:
    if answer.verdict == "no_gap":
        return "Nothing needs to be changed: the simulator agrees with the arm within the noise of the recordings."
    if answer.verdict == "unexplained":
        return "Change nothing yet: look at where the gap is, check cabling, payload and model there, and record again."
    if answer.doubts:
        return "First answer the questions about the recordings; each question names the option that answers it."
    if answer.verdict == "ambiguous":
        return "Record one more motion that separates the candidates; gap plan plans it from the JSON answer."
    return "Add these effects to the simulation: with --out-model the diagnosis writes the corrected model."


def sentence(answer: Diagnosis) -> str:
    """The verdict in a sentence, without a full stop."""
    if answer.verdict == "no_gap":
        return "No significant gap: all residuals are close to the noise floor, or what a sound arm has"
    if answer.verdict == "unexplained" and answer.unexplained < 0.01 and answer.notes:
        return f"Gap not explained: {answer.notes[0]}"
    if answer.verdict == "unexplained":
        return f"Gap not explained: {answer.unexplained:.0%} of it has no known cause"
    if answer.doubts:
        columns = " and ".join(dict.fromkeys(f"{each.channel} of {each.joint}" for each in answer.doubts))
        return f"Cause ambiguous: it depends on what {columns} really contain, which is in doubt"
    first = answer.causes[0]
    if answer.verdict == "ambiguous" and not first.confounded_with:
        hints = ", ".join(cause.effect for cause in answer.causes if cause.confidence < HINT)
        return f"Cause ambiguous: {first.effect} fits, but part of the explanation is only a hint: {hints}"
    if answer.verdict == "ambiguous":
        rivals = rivals_of(first, " or ")
        return f"Cause ambiguous: {first.effect} fits, but {rivals} fits as well; to separate them, {first.separate_by}"
    share = f"{1.0 - answer.unexplained:.0%}"
    return f"Gap explained: {share} of the gap on held-out data, most of it by {first.effect}"


def rivals_of(cause: Cause, between: str) -> str:
    """The effects that fit as well; of many the first four, since the JSON answer has all."""
    names = cause.confounded_with
    if len(names) > 5:
        names = (*names[:4], f"{len(names) - 4} others")
    return between.join(names)


def parameter_rows(cause: Cause) -> list[list[str]]:
    """Rows of a table of what was fitted: effect, joint, parameter, value, interval, unit."""
    return [
        [cause.effect, joint, name, f"{v.value:.4g}", f"{v.low:.3g} to {v.high:.3g}", v.unit]
        for joint, values in cause.parameters.items()
        for name, v in values.items()
    ]
