"""Summary and report of the demo of an arm without torque sensors."""

from pathlib import Path
from typing import Any

import numpy as np
from plotly.subplots import make_subplots
from rich.table import Table

from calib.creep.record import HEADINGS, missing
from calib.creep.record import determined_joints as told
from calib.creep.record import determined_values as values_told
from calib.report.figures import COLOURS, GREY, PANEL, verify_figure
from calib.report.page import ReportSection as Section
from calib.report.page import ReportTable, bullets, paragraph, paragraphs, render
from sim_gap.demo.creep_run import CreepDemo, worst_gain_error
from sim_gap.demo.show import gap_line
from sim_gap.demo.summary import numbers
from sim_gap.report.page import sections as gap_sections

SHOWN = (("gain", 4), ("offset", 3), ("zero", 4), ("coulomb", 3), ("load", 3), ("viscous", 3))
"""Families of the fit to show, with digits."""


def summary(result: CreepDemo) -> dict[str, Any]:
    """`summary.json` of an arm without torque sensors."""
    fit, truth = result.fit, result.run.truth
    true = {"gain": truth.gain, "offset": truth.offset, "position_offset": truth.position_offset}
    found = {"gain": "gain", "offset": "offset", "position_offset": "zero"}
    return result.run.to_json(
        {
            "sensors": {
                name: {
                    "true": numbers(true[name]),
                    "estimated": numbers(values_told(result.fit, family)),
                    "ci95": _intervals(result, family),
                }
                for name, family in found.items()
            },
            "friction": {
                "coulomb": {
                    "true": numbers(result.coulomb),
                    "estimated": numbers(fit.value("coulomb")),
                    "ci95": _intervals(result, "coulomb"),
                },
                **{
                    family: {"estimated": numbers(fit.value(family)), "ci95": _intervals(result, family)}
                    for family in ("load", "viscous", "asymmetry")
                },
            },
            "not_identifiable": {f"{joint}.{parameter}": reason for (joint, parameter), reason in missing(fit).items()},
            "disturbed": list(fit.findings),
            "sag": None
            if result.sag is None
            else {
                "poses": result.sag.poses,
                "nominal": numbers(result.sag.nominal),
                "calibrated": numbers(result.sag.calibrated),
            },
            "drift": None,
        }
    )


def creep_table(result: CreepDemo) -> Table:
    """Estimates with 95 % intervals beside the truth, which was opened only for this table."""
    table = Table(title="torque constants, zeros and friction: estimated ± 95 % (true)")
    for column in ("joint", HEADINGS["gain"], HEADINGS["zero"], HEADINGS["coulomb"]):
        table.add_column(column, justify="left" if column == "joint" else "right")
    truths = {"gain": result.run.truth.gain, "zero": result.run.truth.position_offset, "coulomb": result.coulomb}
    for joint, name in enumerate(result.run.names):
        cells = [f"{_cell(result, family, joint)} ({truth[joint]:.3f})" for family, truth in truths.items()]
        table.add_row(name, *cells)
    return table


def write_creep_report(result: CreepDemo, path: Path) -> None:
    """Write the page; raises OSError."""
    parts = [_overview(result), _calibration(result), _sweeps(result), _gravity(result)]
    subtitle = f"simulated arm {result.run.arm}, hidden truth of seed {result.run.seed}"
    render(path, "armlink demo", [*parts, *gap_sections(result.run.gap)], subtitle)


def _overview(result: CreepDemo) -> Section:
    run = result.run
    check = run.gravity_check
    loaded = check.max_torque > 1e-6
    share = check.rms_error[loaded] / check.max_torque[loaded]
    unseen = [name for name, seen in zip(run.names, result.fit.found("gain"), strict=True) if not seen]
    items = [
        f"{run.bus.frames:,} CAN frames in {run.sim_s:.0f} s of the arm's time at {run.bus.rate_hz:.0f} Hz;"
        f" {run.wall_s:.0f} s on this machine.",
        f"Torque constants found to {worst_gain_error(result):.2%} at worst"
        + (f"; not observable on {', '.join(unseen)}." if unseen else "."),
        f"Gravity torque in true N·m within {share.max():.2%} RMS of each joint's largest, at {check.poses} poses.",
        gap_line(run.gap) + ".",
    ]
    if result.sag is not None:
        before, after = (np.degrees(each.max()) for each in (result.sag.nominal, result.sag.calibrated))
        items.insert(3, f"Held by a tenth of the gains, the worst joint sags by {after:.1f}° instead of {before:.1f}°.")
    text = (
        "This arm has no torque sensors: each drive reports current times a torque constant that is wrong. The fit saw"
        " only what came over the bus. What is called true was opened after everything was estimated."
    )
    return Section("In short", paragraph(text) + bullets(items))


def _calibration(result: CreepDemo) -> Section:
    rows = [
        [name, f"{result.run.truth.gain[j]:.4f}", *(_cell(result, family, j) for family, _ in SHOWN)]
        for j, name in enumerate(result.run.names)
    ]
    header = ("joint", "true reading per N·m", *(HEADINGS[family] for family, _ in SHOWN))
    reasons = [f"{joint}, {what.replace('_', ' ')}: {why}" for (joint, what), why in missing(result.fit).items()]
    lines = [*reasons, *result.fit.findings]
    text = "Estimated ± half of the 95 % interval. The host keeps these values and corrects readings and commands."
    return Section(
        "Torque constants, zeros and friction",
        paragraph(text) + paragraphs(lines),
        [],
        [ReportTable(header, rows)],
    )


def _sweeps(result: CreepDemo) -> Section:
    text = (
        "One joint at a time creeps through its range, up (▸) and down (◂). Half the sum of both ways is gravity, half"
        " the difference friction. Lines are the fit of all sweeps together; a colour is a sweep of one pass."
    )
    return Section("Creep sweeps", paragraph(text), [_sweep_figure(result)])


def _sweep_figure(result: CreepDemo) -> Any:
    fit, n = result.fit, len(result.run.names)
    rows, residual = fit.rows, fit.solution.residual
    figure = make_subplots(rows=n, cols=1, subplot_titles=[f"{name}: reading [N·m]" for name in result.run.names])
    for joint in range(n):
        own = np.flatnonzero(rows.joint == joint)
        for number, sweep in enumerate(np.unique(rows.sweep[own])):
            for side, symbol in ((1.0, "triangle-right"), (-1.0, "triangle-left")):
                each = own[(rows.sweep[own] == sweep) & (rows.side[own] == side)]
                each = each[np.argsort(rows.position[each, joint])]
                place = {"row": joint + 1, "col": 1, "showlegend": False}
                colour = COLOURS[number % len(COLOURS)]
                at = rows.position[each, joint]
                figure.add_scatter(
                    x=at, y=rows.reading[each], mode="markers", marker={"symbol": symbol, "color": colour}, **place
                )
                modelled = rows.reading[each] - residual[each]
                figure.add_scatter(x=at, y=modelled, mode="lines", line={"color": GREY, "width": 1}, **place)
    figure.update_xaxes(title_text="position reading [rad]", row=n)
    return figure.update_layout(height=PANEL * n + 80)


def _gravity(result: CreepDemo) -> Section:
    check, verify, sag = result.run.gravity_check, result.run.verify, result.sag
    columns = [verify.rms, check.rms_error, check.max_torque]
    header = ["joint", "RMS, model to half sums", "RMS, model to truth", "largest torque"]
    if sag is not None:
        columns += [np.degrees(sag.nominal), np.degrees(sag.calibrated)]
        header += ["sag, nominal model [°]", "sag, calibrated [°]"]
    rows = [[name, *(f"{column[j]:.4f}" for column in columns)] for j, name in enumerate(result.run.names)]
    text = f"Model torque and half sums of short creeps at {len(verify.position)} poses that were not used for any fit."
    table = ReportTable(header, rows, f"N·m; the truth is the plant's own gravity at {check.poses} random poses.")
    return Section("Gravity model", paragraph(text), [verify_figure(verify)], [table])


def _intervals(result: CreepDemo, family: str) -> list[list[float | None] | None]:
    seen = np.isfinite(values_told(result.fit, family))
    return [numbers(row) if kept else None for row, kept in zip(result.fit.ci95(family), seen, strict=True)]


def _cell(result: CreepDemo, family: str, joint: int) -> str:
    if not told(result.fit, family)[joint]:
        return "not observable"
    half = 1.96 * result.fit.std(family)[joint]
    digits = dict(SHOWN)[family]
    return f"{result.fit.value(family)[joint]:.{digits}f} ± {half:.{digits}f}"
