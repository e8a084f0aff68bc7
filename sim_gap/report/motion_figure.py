"""Motion of every joint along held-out commands: measured, and as the nominal and the corrected model move."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.report.page import ReportSection as Section
from calib.report.page import paragraph
from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import Cause
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
from sim_gap.report.figures import BLUE, GREY, ORANGE
from sim_gap.report.time_figures import MOST_LEFT_OUT, SHOWN_S, Line, lines_over_time, lines_without_each


def motion_sections(found: Identified, causes: Sequence[Cause]) -> list[Section]:
    """A section with the motion of every joint, if there is any to show."""
    figure = motion_figure(found, causes)
    text = (
        "The command, the measured motion, and simulations that run free along the command, on held-out data. Click a "
        "name to hide or show its curve; “without” leaves one effect out of the corrected model."
    )
    return [] if figure is None else [Section("Motion of every joint", paragraph(text), [figure])]


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
