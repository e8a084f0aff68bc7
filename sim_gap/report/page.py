"""The diagnosis as sections of a report: verdict, causes, gap before and after, figures of the residuals."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from armlink.effect_catalogue import CATALOGUE
from calib.report.page import ReportSection as Section
from calib.report.page import html_of, paragraph, paragraphs, render, verdict_line
from calib.report.tables import ReportTable
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.position_gap.identify import Identified
from sim_gap.report.effect_text import CHANNEL_WORDS, WORDS, advice, parameter_rows, rivals_of, sentence
from sim_gap.report.figures import (
    cause_figure,
    gap_bars,
    law_figure,
    motion_figure,
    residual_panels,
    rollout_bars,
    torque_over_time,
)

PARAMETERS = {
    "N·m": "Fitted parameters, each as a difference from the value of the model.",
    "rad": (
        "Fitted parameters: for joints and controller the values of the arm, for links, zeros and base the "
        "change relative to the model."
    ),
}
"""Meaning of the parameters of a diagnosis, by the unit of its gap."""
MOTION = (
    "The command, the measured motion, and free-running simulations along the command, on held-out data. Click a "
    "name to hide or show its curve; “without” leaves one effect out of the corrected model."
)


def sections(answer: Diagnosis) -> list[Section]:
    out = [_verdict(answer), _gap(answer)]
    if isinstance(answer.internals, Identified):
        shown = {"Motion of every joint": (MOTION, [motion_figure(answer.internals, answer.causes)])}
        return out + _sections_of(shown)
    if answer.internals is None:
        return out
    layout = answer.internals.heldout.layout
    for channel in reversed(layout.chain):
        model = channel == layout.against_model
        nominal = "prediction of the nominal model" if model else "prediction from the readings of the torque sensor"
        words = CHANNEL_WORDS[channel]
        text = (
            f"The {words} of every joint on held-out data: the measurement, the {nominal}, and the "
            "prediction with the causes added. Click a name to hide or show its curve; “without” leaves one effect out."
        )
        out += _sections_of({f"Every joint over time: {words}": (text, [torque_over_time(answer, channel)])})
    return [*out, *_sections_of(_parts_of_causes(answer)), *_residuals(answer)]


def _sections_of(parts: Mapping[str, tuple[str, Sequence[Any]]]) -> list[Section]:
    """A section with a title, a text and figures of each part that has a figure."""
    figures = {title: [figure for figure in made if figure is not None] for title, (_, made) in parts.items()}
    return [Section(title, paragraph(text), figures[title]) for title, (text, _) in parts.items() if figures[title]]


def _parts_of_causes(answer: Diagnosis) -> dict[str, tuple[str, Sequence[Any]]]:
    return {
        "The causes one by one": (
            "Each cause at the joint and channel where it explains most, on held-out data: grey is the residual minus "
            "all other causes, orange is the contribution of this cause. A correct cause follows the centre of the "
            "grey points.",
            [cause_figure(answer, cause) for cause in answer.causes],
        ),
        "Laws without a known cause": (
            "Here the part of the torque that no known effect explains follows one quantity of the joint. The law was "
            "fitted to the training data; grey points are held-out data. The law says how the torque varies, not why.",
            [law_figure(answer, law) for law in answer.laws],
        ),
    }


def write_report(answer: Diagnosis, path: Path, subtitle: str = "") -> None:
    render(path, "Sim-to-real gap", sections(answer), subtitle)


def _verdict(answer: Diagnosis) -> Section:
    html = verdict_line(WORDS[answer.verdict], sentence(answer)) + paragraph(advice(answer)) + paragraphs(answer.notes)
    tables = []
    if answer.causes:
        tables.append(
            ReportTable(
                ("effect", "joints", f"RMS before [{answer.unit}]", f"after [{answer.unit}]", "shrink", "confidence"),
                [_cause_row(cause) for cause in answer.causes],
                "Causes in order; each row adds its cause to the causes above it. RMS on held-out data, "
                "over the joints of the cause.",
                texts=2,
            )
        )
    minor = answer.minor if isinstance(answer.internals, Identified) else ()  # those of torque weigh nothing
    if rows := [row for cause in (*answer.causes, *minor) for row in parameter_rows(cause)]:
        tables.append(
            ReportTable(
                ("effect", "joint", "parameter", "value", "95 % interval", "unit"),
                rows,
                PARAMETERS[answer.unit],
                texts=3,
            )
        )
    return Section("Verdict and causes", html, [gap_bars(answer)], tables)


def _cause_row(cause: Cause) -> list[str]:
    effect = html_of("<b>{}</b>", cause.effect)
    if cause.effect in CATALOGUE:  # effects of a position controller are not: no sweep knows them
        effect += html_of("<br><small>{}</small>", CATALOGUE[cause.effect].description)
    if cause.confounded_with:
        effect += html_of("<br><small>or {}: {}</small>", rivals_of(cause, ", "), cause.separate_by or "")
    return [
        effect,
        ", ".join(cause.joints),
        f"{cause.gap_before:.3g}",
        f"{cause.gap_after:.3g}",
        f"{cause.shrink:.0%}",
        f"{cause.confidence:.2f}",
    ]


def _gap(answer: Diagnosis) -> Section:
    train, heldout = (answer.train_before, answer.train_after), (answer.heldout_before, answer.heldout_after)
    joints = zip(answer.names, answer.noise_floor, *train, *heldout, strict=True)
    rows = [[name, *(f"{x:.3g}" for x in numbers)] for name, *numbers in joints]
    header = ("joint", "noise floor", "training data: before", "after", "held-out data: before", "after")
    text = (
        f"RMS gap of the simulation per joint, in {answer.unit}, before and after the causes were added to "
        f"the nominal model. The held-out data, {answer.heldout_is}, were used neither for the fit nor for "
        "the selection of effects."
    )
    figures = [] if answer.rollout is None else [rollout_bars(answer.names, answer.rollout)]
    return Section("Gap before and after", paragraph(text), figures, [ReportTable(header, rows)])


def _residuals(answer: Diagnosis) -> list[Section]:
    locations = {(at.channel, at.joint): at for at in answer.where}
    header = ("joint", "correlates with", "share", "RMS [N·m]", "noise [N·m]")
    caption = "For each residual, the regime of motion with the largest share of its mean square."
    layout, out = answer.internals.heldout.layout, []
    for channel in reversed(layout.chain):
        here = ((name, locations.get((channel, name))) for name in answer.names)
        rows = [[name, at.regime, f"{at.share:.0%}", f"{at.rms:.3g}", f"{at.noise:.2g}"] for name, at in here if at]
        figure, words = residual_panels(answer, channel), CHANNEL_WORDS[channel]
        against = "the model" if channel == layout.against_model else "the torque sensor"
        text = (
            f"The {words} minus the prediction of {against} on held-out data: grey is the measurement, orange is "
            "the sum of the causes."
        )
        figures = [] if figure is None else [figure]
        table = ReportTable(header, rows, caption, texts=2)
        out.append(Section(f"Residuals of the {words}", paragraph(text), figures, [table]))
    return out
