"""Report of a position-only diagnosis: causes, gap in radians, real, nominal and corrected motion of every joint."""

from html import escape
from typing import Any

import numpy as np
from plotly.subplots import make_subplots

from armlink.recording.recording import Recording
from calib.report.page import ReportTable, Section, paragraph
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.closed_loop.identify import Identified
from sim_gap.closed_loop.training.replay import Simulated, replay, simulated
from sim_gap.report.effect_text import WORDS, advice, sentence
from sim_gap.report.figures import BELOW_TITLE, BLUE, GREY, ORANGE

SHOWN_S = 15.0
"""Length of the motion that is shown [s]."""
POINTS = 750


def position_sections(answer: Diagnosis) -> list[Section]:
    """Sections for a separate page or for a part of another report."""
    html = f'<p><span class="verdict">{escape(WORDS[answer.verdict])}</span> {escape(sentence(answer))}.</p>'
    html += "" if answer.verdict == "ambiguous" else paragraph(advice(answer))  # else the sentence has it
    html += "".join(paragraph(note) for note in answer.notes)
    header = ("effect", "joints", "RMS before [rad]", "after [rad]", "confidence", "or")
    causes = ReportTable(header, [_cause_row(cause) for cause in answer.causes], "Causes, on held-out data.", texts=2)
    rows = [row for cause in (*answer.causes, *answer.minor) for row in _parameter_rows(cause)]
    parameters = ReportTable(
        ("effect", "joint", "parameter", "value", "95 % interval", "unit"), rows, "Fitted parameters.", texts=3
    )
    gap = [
        [escape(name), *(f"{x:.3g}" for x in numbers)]
        for name, *numbers in zip(
            answer.names, answer.noise_floor, answer.heldout_before, answer.heldout_after, strict=True
        )
    ]
    table = ReportTable(("joint", "noise floor", "before", "after"), gap, f"RMS in rad on {answer.heldout_is}.")
    out = [Section("Verdict and causes", html, (), [causes, parameters]), Section("Gap", "", (), [table])]
    figure = motion_figure(answer.internals) if isinstance(answer.internals, Identified) else None
    if figure is not None:
        text = (
            "The command, the measured motion, and simulations that run free along the command, on held-out data. "
            "Click a name to hide or show it."
        )
        out.append(Section("Motion of every joint", paragraph(text), [figure]))
    return out


def motion_figure(found: Identified) -> Any:
    """One row a joint: measured, nominal and corrected motion; None if the model did not come from a file."""
    if found.export is None:
        return None
    recording, names, gain = _shortened(found.recordings[0]), found.sim.arm.names, found.gains[0]
    corrected = simulated(found.sim, found.beside or found.export)
    t, after, measured = replay(corrected.with_gain(gain), recording)
    lines = [("command", recording.position_command[: len(t)], GREY), ("measured", measured, "black")]  # type: ignore[index]
    if found.nominal_has_controller:
        nominal = Simulated(found.sim.mujoco_model, found.sim.joints).with_gain(gain)
        lines.append(("nominal model", replay(nominal, recording)[1], ORANGE))
    lines.append(("corrected model", after, BLUE))
    figure = make_subplots(rows=len(names), cols=1, shared_xaxes=True, subplot_titles=list(names))
    every = max(1, len(t) // POINTS)
    for label, values, colour in lines:
        for j in range(len(names)):
            figure.add_scatter(
                x=(t - t[0])[::every].round(3),
                y=np.asarray(values)[::every, j].round(5),
                name=label,
                legendgroup=label,
                showlegend=j == 0,
                line={"color": colour, "width": 1.4},
                row=j + 1,
                col=1,
            )
    figure.update_yaxes(title="rad")
    figure.update_xaxes(title="time [s]", row=len(names), col=1)
    figure.update_layout(height=120 + 190 * len(names), legend=BELOW_TITLE)
    return figure


def _shortened(recording: Recording) -> Recording:
    from armlink.recording.recording import slice_rows

    return slice_rows(recording, recording.t <= recording.t[0] + SHOWN_S)


def _cause_row(cause: Cause) -> list[str]:
    return [
        f"<b>{escape(cause.effect)}</b>",
        escape(", ".join(cause.joints)),
        f"{cause.gap_before:.3g}",
        f"{cause.gap_after:.3g}",
        f"{cause.confidence:.2f}",
        escape(", ".join(cause.confounded_with)),
    ]


def _parameter_rows(cause: Cause) -> list[list[str]]:
    return [
        [escape(cause.effect), escape(joint), escape(name), f"{v.value:.4g}", f"{v.low:.4g} … {v.high:.4g}", v.unit]
        for joint, values in cause.parameters.items()
        for name, v in values.items()
    ]
