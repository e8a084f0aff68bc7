"""Tables as other tools write them: separators, decimal commas, dates, lists, names and units in the header."""

import re
import shlex
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pa_parquet
import pytest

from armlink.errors import BadInput
from armlink.recording.column_names import joint_names, suggested_map
from armlink.recording.corrections import Corrections, parse_corrections
from armlink.recording.files import load_recording

ROWS = [[0.01 * k, 0.5 + 0.1 * k, -0.25 * k, 1.5, 2.5 + k] for k in range(8)]
HEADER = ["t", "q_1", "q_2", "tau_motor_1", "tau_motor_2"]


def write(
    path: Path, separator: str = ",", decimal: str = ".", end: str = "\n", above: str = "", header=HEADER
) -> Path:
    lines = [separator.join(header)]
    lines += [separator.join(f"{x:.4f}".replace(".", decimal) for x in row) for row in ROWS]
    path.write_text(above + end.join(lines) + end, newline="")
    return path


@pytest.mark.parametrize(
    "layout",
    [
        {"separator": ";", "decimal": ","},
        {"separator": ";"},
        {"separator": "\t"},
        {"separator": " "},
        {"separator": ";", "decimal": ",", "end": "\r\n", "above": "\ufeff"},
        {"above": "# made by hand\n# at 100 Hz\n"},
        {"header": ["# t", *HEADER[1:]]},
        {"header": ['"t"', *HEADER[1:]]},
    ],
)
def test_a_table_is_read_as_it_is_written(tmp_path, layout):
    loaded = load_recording(write(tmp_path / "r.csv", **layout))
    np.testing.assert_allclose(loaded.t, [row[0] for row in ROWS])
    np.testing.assert_allclose(loaded.position, [row[1:3] for row in ROWS])
    np.testing.assert_allclose(loaded.motor_torque, [row[3:] for row in ROWS])


def test_dates_are_seconds_from_the_first(tmp_path):
    lines = ["timestamp,q_1,tau_1", *(f"2026-11-24 12:00:0{k}.25,{k},1" for k in range(4))]
    (tmp_path / "r.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(BadInput, match=r"try --map t=timestamp$"):
        load_recording(tmp_path / "r.csv")
    loaded = load_recording(tmp_path / "r.csv", parse_corrections(columns=["t=timestamp"]))
    np.testing.assert_allclose(loaded.t, np.arange(4.0))
    (tmp_path / "r.csv").write_text("t,q_1,tau_1\nnoon,0,1\nlater,1,1\n")
    with pytest.raises(BadInput, match="t is 'noon', expected a number"):
        load_recording(tmp_path / "r.csv")


def test_a_table_without_a_header_row_says_so(tmp_path):
    (tmp_path / "r.csv").write_text("0.0,1.0,2.0\n0.1,1.0,2.0\n")
    with pytest.raises(BadInput, match="its first row holds numbers instead of the names of the columns"):
        load_recording(tmp_path / "r.csv")


def test_columns_of_lists_count_as_one_a_joint(tmp_path):
    lists = {"t": [row[0] for row in ROWS], "q": [row[1:3] for row in ROWS], "tau_motor": [row[3:] for row in ROWS]}
    pa_parquet.write_table(pa.table(lists), tmp_path / "r.parquet")
    loaded = load_recording(tmp_path / "r.parquet")
    np.testing.assert_allclose(loaded.position, [row[1:3] for row in ROWS])
    np.testing.assert_allclose(loaded.motor_torque, [row[3:] for row in ROWS])


def pasted(suggestion: str) -> Corrections:
    """What the printed options state."""
    words = shlex.split(suggestion)
    options = dict(zip(words[::2], words[1::2], strict=True))
    return parse_corrections(columns=[options["--map"]], units=[options.get("--units", "")] if len(options) > 1 else ())


def test_the_printed_options_load_names_and_units(tmp_path):
    header = ["time [ms]", "elbow_joint/pos [deg]", "wrist_1_joint/pos [deg]", "elbow_joint/eff", "wrist_1_joint/eff"]
    path = write(tmp_path / "r.csv", header=header)
    with pytest.raises(BadInput) as refused:
        load_recording(path)
    options = re.search(r"try (--map .*)", str(refused.value)).group(1)
    loaded = load_recording(path, pasted(options))
    assert loaded.names == ("elbow_joint", "wrist_1_joint")
    np.testing.assert_allclose(np.degrees(loaded.position), [row[1:3] for row in ROWS])
    np.testing.assert_allclose(loaded.t, [1e-3 * row[0] for row in ROWS])


def test_numbers_alone_are_no_joint_names():
    assert joint_names(["actual_q_0", "actual_q_1"]) == ()
    assert joint_names(["/joint_states/elbow_joint/position", "/joint_states/wrist_1/position"]) == (
        "elbow_joint",
        "wrist_1",
    )
    assert suggested_map(["t", "q_1", "tau_1"]) == ""


@pytest.mark.parametrize("separator", [",", ";", " ", "\t"])
def test_a_table_without_a_header_row(tmp_path, separator):
    values = np.random.default_rng(1128).uniform(-1.0, 1.0, (20, 4))
    values[:, 0] = 0.02 * np.arange(20)
    text = "\n".join(separator.join(f"{x:.9f}" for x in row) for row in values) + "\n"
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(BadInput, match=r"--columns t,q_1"):
        load_recording(tmp_path / "run.csv")
    loaded = load_recording(tmp_path / "run.csv", parse_corrections(header="t,-,q_1,q_cmd_1"))
    np.testing.assert_allclose(loaded.t, values[:, 0])
    np.testing.assert_allclose(loaded.position[:, 0], values[:, 2], atol=1e-8)
    np.testing.assert_allclose(loaded.position_command[:, 0], values[:, 3], atol=1e-8)


@pytest.mark.parametrize(
    ("header", "text", "said"),
    [
        ("t,q_1", "0,1,2\n1,2,3\n", "names 2 columns, but the rows of the file have 3"),
        ("t,q_1,tau_1", "t,q,tau\n0,1,2\n1,2,3\n", "its first row holds the names of the columns"),
        ("t,angle", "0,1\n1,2\n", "--columns angle: a recording has no such column"),
        ("t,q_1,q_1", "0,1,2\n1,2,3\n", "--columns q_1: this column is named twice"),
    ],
)
def test_columns_that_do_not_fit_a_table_are_one_error(tmp_path, header, text, said):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(BadInput, match=said):
        load_recording(tmp_path / "run.csv", parse_corrections(header=header))
