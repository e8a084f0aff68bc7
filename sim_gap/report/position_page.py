"""Report of a position-only diagnosis: causes, gap in radians, real, nominal and corrected motion of every joint."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.report.page import ReportSection as Section
from calib.report.page import html_of, paragraph, paragraphs, verdict_line
from calib.report.tables import ReportTable
from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.position_gap.identify import Identified
from sim_gap.position_gap.training.export import WRITTEN
from sim_gap.position_gap.training.replay import (
    Simulated,
    commanded_rows,
    nominal,
    replay,
    simulated_model,
    without_groups,
)
from sim_gap.report.effect_text import WORDS, advice, parameter_rows, sentence
from sim_gap.report.figures import BLUE, GREY, ORANGE
from sim_gap.report.time_figures import MOST_LEFT_OUT, SHOWN_S, Line, lines_over_time, lines_without_each


def position_sections(answer: Diagnosis) -> list[Section]:
    """Sections for a separate page or for a part of another report."""
    html = verdict_line(WORDS[answer.verdict], sentence(answer))
    if answer.verdict != "ambiguous":  # else the sentence has it
        html += paragraph(advice(answer))
    html += paragraphs(answer.notes)
    header = ("effect", "joints", "RMS before [rad]", "after [rad]", "confidence", "or")
    causes = ReportTable(header, [_cause_row(cause) for cause in answer.causes], "Causes, on held-out data.", texts=2)
    rows = [row for cause in (*answer.causes, *answer.minor) for row in parameter_rows(cause)]
    parameters = ReportTable(
        ("effect", "joint", "parameter", "value", "95 % interval", "unit"), rows, "Fitted parameters.", texts=3
    )
    gap = [
        [name, *(f"{x:.3g}" for x in numbers)]
        for name, *numbers in zip(
            answer.names, answer.noise_floor, answer.heldout_before, answer.heldout_after, strict=True
        )
    ]
    table = ReportTable(("joint", "noise floor", "before", "after"), gap, f"RMS in rad on {answer.heldout_is}.")
    out = [Section("Verdict and causes", html, (), [causes, parameters]), Section("Gap", tables=[table])]
    figure = motion_figure(answer.internals, answer.causes) if isinstance(answer.internals, Identified) else None
    if figure is not None:
        text = (
            "The command, the measured motion, and simulations that run free along the command, on held-out data. "
            "Click a name to hide or show it; “without” leaves one effect out of the corrected model."
        )
        out.append(Section("Motion of every joint", paragraph(text), [figure]))
    return out


def motion_figure(found: Identified, causes: Sequence[Cause] = ()) -> Any:
    """One row a joint: measured, nominal and corrected motion, and without each cause; None without a model's
    file or without a command."""
    made = found.beside or found.export
    if made is None:
        return None
    recording, names, gain = found.recordings[0], found.sim.arm.names, found.gains[0]

    def moved(arm: Simulated) -> tuple[Array, Array, Array]:
        return replay(arm.with_gain(gain), recording, SHOWN_S)

    t, after, measured = moved(simulated_model(found.sim, made))
    if not len(t):
        return None
    command = recording.position_command
    assert command is not None
    lines: list[Line] = [
        ("command", np.concatenate([command[rows] for rows in commanded_rows(recording, SHOWN_S)]), GREY, True),
        ("measured", measured, "black", True),
    ]
    if found.nominal_has_controller:
        lines.append(("nominal model", moved(nominal(found.sim))[1], ORANGE, True))
    lines.append(("corrected model", after, BLUE, True))
    left_out = list(dict.fromkeys(cause.effect for cause in causes if cause.effect in WRITTEN))[:MOST_LEFT_OUT]
    groups = [[stage.group for stage in found.stages if stage.group[0].partition("@")[0] == e] for e in left_out]
    lines += lines_without_each(
        left_out, [moved(without_groups(found.sim, found.search, made, own))[1] for own in groups]
    )
    return lines_over_time(t - t[0], names, lines, "rad")


def _cause_row(cause: Cause) -> list[str]:
    return [
        html_of("<b>{}</b>", cause.effect),
        ", ".join(cause.joints),
        f"{cause.gap_before:.3g}",
        f"{cause.gap_after:.3g}",
        f"{cause.confidence:.2f}",
        ", ".join(cause.confounded_with),
    ]
