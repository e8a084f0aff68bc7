"""The diagnosis as sections of a report: verdict, causes, gap before and after, and the residuals in pictures."""

from html import escape
from pathlib import Path
from typing import Any

from calib.report.page import ReportTable, Section, paragraph, render
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.report.cause_figures import finding_figure
from sim_gap.report.effect_text import PLAIN, sentence
from sim_gap.report.figures import gap_bars, residual_panels, rollout_bars


def sections(answer: Diagnosis) -> list[Section]:
    """Sections for a page of its own or within another report."""
    out = [_verdict(answer), _gap(answer)]
    if answer.internals is not None:
        out += [*_findings(answer), *_residuals(answer)]
    return out


def write_report(answer: Diagnosis, path: Path, title: str = "Sim-to-real gap", subtitle: str = "") -> None:
    """Write one self-contained HTML file."""
    render(path, title, sections(answer), subtitle)


def _verdict(answer: Diagnosis) -> Section:
    html = f'<p><span class="verdict">{escape(answer.verdict)}</span> {escape(sentence(answer))}.</p>'
    html += "".join(paragraph(note) for note in answer.notes)
    tables = []
    if answer.causes:
        tables.append(
            ReportTable(
                ("effect", "joints", "RMS before [N·m]", "after [N·m]", "shrink", "confidence"),
                [_cause_row(cause) for cause in answer.causes],
                "Causes in order, each added to those above it; RMS on motion not fitted, over the joints named.",
                texts=2,
            )
        )
        tables.append(
            ReportTable(
                ("effect", "joint", "parameter", "value", "95 % interval", "unit"),
                [row for cause in answer.causes for row in _parameter_rows(cause)],
                "Fitted parameters.",
                texts=3,
            )
        )
    return Section("What causes the gap", html, (), tables)


def _cause_row(cause: Cause) -> list[str]:
    doubt = f"<br><small>or {escape(', '.join(cause.confounded_with))}: {escape(cause.separate_by or '')}</small>"
    return [
        f"<b>{escape(cause.effect)}</b><br><small>{escape(PLAIN.get(cause.effect, ''))}</small>"
        + (doubt if cause.confounded_with else ""),
        escape(", ".join(cause.joints)),
        f"{cause.gap_before:.3g}",
        f"{cause.gap_after:.3g}",
        f"{cause.shrink:.0%}",
        f"{cause.confidence:.2f}",
    ]


def _parameter_rows(cause: Cause) -> list[list[str]]:
    return [
        [escape(cause.effect), escape(joint), escape(name), f"{v.value:.4g}", f"{v.low:.4g} … {v.high:.4g}", v.unit]
        for joint, values in cause.parameters.items()
        for name, v in values.items()
    ]


def _gap(answer: Diagnosis) -> Section:
    rows = [
        [escape(name), *(f"{x:.3g}" for x in numbers)]
        for name, *numbers in zip(
            answer.names,
            answer.noise_floor,
            answer.train_before,
            answer.train_after,
            answer.heldout_before,
            answer.heldout_after,
            strict=True,
        )
    ]
    header = ("joint", "noise floor", "fitted motion: before", "after", "other motion: before", "after")
    text = (
        f"Torque gap of the simulation, RMS in N·m per joint, as the model stands and with the causes added. "
        f"The other motion is {answer.heldout_is}; nothing was fitted or chosen on it."
    )
    figures: list[Any] = [gap_bars(answer)]
    if answer.rollout is not None:
        figures.append(rollout_bars(answer.names, answer.rollout))
    return Section("How far it closes", paragraph(text), figures, [ReportTable(header, rows)])


def _findings(answer: Diagnosis) -> list[Section]:
    """A figure for every cause."""
    figures = [finding_figure(answer, cause) for cause in answer.causes]
    shown = [figure for figure in figures if figure is not None]
    if not shown:
        return []
    text = (
        "Each cause where it explains most, on the other motion: grey is the residual less all other causes, orange "
        "what this cause makes of it. Where it is right, orange lies in the middle of grey."
    )
    return [Section("The causes one by one", paragraph(text), shown)]


def _residuals(answer: Diagnosis) -> list[Section]:
    places = {(p.channel, p.joint): p for p in answer.where}
    data = answer.internals.heldout
    channels = [c for c in (data.layout.sensor, data.layout.motor) if c]
    out = []
    for channel in channels:
        against = "the model" if channel == data.layout.against_model else "the torque sensor"
        rows = [
            [escape(name), p.regime, f"{p.share:.0%}", f"{p.rms:.3g}", f"{p.noise:.2g}"]
            for name in answer.names
            if (p := places.get((channel, name))) is not None
        ]
        header = ("joint", "goes with", "share", "RMS [N·m]", "noise [N·m]")
        text = f"{channel} minus {against} on the other motion, grey as it is, orange what the causes explain of it."
        table = ReportTable(header, rows, "The regime that accounts for most of each residual's square.", texts=2)
        figure = residual_panels(answer, channel)
        out.append(Section(f"Where: {channel}", paragraph(text), [figure] if figure is not None else [], [table]))
    return out
