"""Pictures of a diagnosis: each residual over velocity, position, load and time, and a figure for each cause."""

import numpy as np
import pytest
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.report import page
from sim_gap.report.figures import cause_figure, residual_panels, torque_over_time
from sim_gap.report.page import sections

WRONG = Wrong(coulomb=np.array([0.0, 0.8, 0.0]), spring=np.array([0.0, 0.0, 2.0]))


@pytest.fixture(scope="module")
def answer():
    train, other = (record(model(), WRONG, seed=seed, seconds=30, rate=50) for seed in (1, 2))
    return diagnose(model(), [train], [other])


def test_a_residual_is_shown_over_velocity_position_load_and_time_for_every_joint(answer):
    figure = residual_panels(answer, "tau")
    grey = [trace for trace in figure.data if trace.name == "residual"]
    assert len(grey) == 4 * 3
    shown = answer.internals.heldout
    for trace, x in zip(grey[4:7], (shown.signals[0].v, shown.signals[0].q, shown.signals[0].model), strict=True):
        assert np.ptp(trace.x) == pytest.approx(np.ptp(shown.signals[0].filtered(x)[:, 1]), rel=0.05)
    assert grey[7].x[-1] == pytest.approx(30.0, abs=1.0)


def test_every_cause_has_its_figure_and_lies_in_the_middle_of_what_it_explains(answer):
    figures = {cause.effect: cause_figure(answer, cause) for cause in answer.causes}
    assert figures.keys() == {"friction.coulomb", "transmission.spring"}
    for effect, axis in (("friction.coulomb", "velocity"), ("transmission.spring", "position")):
        left, explained = figures[effect].data
        assert figures[effect].layout.xaxis.title.text.startswith(axis)
        assert np.std(left.y - explained.y) < 0.1 * np.std(left.y)
    (section,) = [s for s in sections(answer) if s.title == "The causes one by one"]
    assert len(section.figures) == 2


def test_every_joint_is_shown_over_time_as_measured_nominal_and_corrected_and_without_each_cause(answer):
    figure = torque_over_time(answer, "tau_motor")
    lines = {(trace.name, trace.yaxis): trace for trace in figure.data}
    names = {name for name, _ in lines}
    assert names == {"measured", "nominal", "corrected", "without friction.coulomb", "without transmission.spring"}
    assert len(lines) == 3 * len(names)
    shown = {trace.name for trace in figure.data if trace.visible is True}
    assert shown == {"measured", "nominal", "corrected"}
    measured, nominal, corrected, less = (
        np.array(lines[name, "y2"].y) for name in ("measured", "nominal", "corrected", "without friction.coulomb")
    )
    assert np.std(corrected - measured) < 0.2 * np.std(nominal - measured)
    assert np.median(np.abs(corrected - less)) == pytest.approx(0.8, rel=0.1)
    line = lines["measured", "y2"]
    assert line.x0 + line.dx * (len(line.y) - 1) == pytest.approx(15.0, abs=0.2)
    titles = [section.title for section in sections(answer)]
    assert "Every joint over time: motor torque" in titles


def test_it_begins_with_what_to_do_and_its_headings_are_words(answer):
    shown = sections(answer)
    assert "with --out-model the diagnosis writes the corrected model" in shown[0].html
    assert "Residuals of the torque sensor" in [section.title for section in shown]
    titles = [section.title for section in shown]
    for figure in (figure for section in shown for figure in section.figures):
        layout = figure.to_dict()["layout"]
        titles += [
            layout[axis].get("title", {}).get("text", "") for axis in layout if axis.startswith(("xaxis", "yaxis"))
        ]
    titles = [title.replace("joint_", "") for title in titles]
    assert [title for title in titles if "tau" in title or "_" in title] == []


def test_a_channel_without_a_figure_is_told_in_its_table(answer, monkeypatch):
    monkeypatch.setattr(page, "residual_panels", lambda answer, channel: None)
    assert [section.figures for section in page._residuals(answer)] == [[], []]
    monkeypatch.setattr(page, "residual_panels", lambda answer, channel: channel)
    assert [section.figures for section in page._residuals(answer)] == [["tau"], ["tau_motor"]]
