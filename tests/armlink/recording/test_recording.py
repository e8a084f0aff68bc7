"""Recordings: what is written comes back, and what cannot be used is said in one line."""

import contextlib
import math
import subprocess
import sys
import zlib

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armlink.errors import BadInput
from armlink.recording.files import load_recording, save_recording
from armlink.recording.parquet import numbers
from armlink.recording.recording import Recording, slice_rows


@pytest.fixture
def recording():
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.integers(1, 10_000_000, 200)) * 1e-9
    channels = {name: rng.normal(size=(200, 3)) for name in ("position", "velocity", "torque", "motor_torque")}
    channels["motor_torque"][::4] = np.nan
    commands = {name: rng.normal(size=(200, 3)) for name in ("torque_command", "position_command", "temperature")}
    return Recording(t=t - t[0], names=("a", "b", "c"), **channels, **commands)


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".mcap"])
def test_what_is_saved_loads_the_same(recording, tmp_path, suffix):
    save_recording(recording, tmp_path / f"r{suffix}")
    loaded = load_recording(tmp_path / f"r{suffix}")
    assert loaded.warning == ""
    np.testing.assert_allclose(loaded.t, recording.t, rtol=0, atol=1e-9)
    assert loaded.channels().keys() == recording.channels().keys()
    for name, values in recording.channels().items():
        np.testing.assert_array_equal(loaded.channels()[name], values)
    assert loaded.names == (recording.names if suffix in (".parquet", ".mcap") else ("joint_1", "joint_2", "joint_3"))


def test_csv_has_the_columns_of_the_contract(recording, tmp_path):
    save_recording(slice_rows(recording, slice(0, 2)), tmp_path / "r.csv")
    header, first, _ = (tmp_path / "r.csv").read_text().splitlines()
    assert header.split(",")[:5] == ["t", "q_1", "q_2", "q_3", "dq_1"]
    assert "tau_motor_3" in header
    assert "temp_3" in header
    assert first.split(",")[header.split(",").index("tau_motor_1")] == ""


def csv(tmp_path, text, name="r.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_columns_may_be_in_any_order_and_strangers_are_named(tmp_path):
    loaded = load_recording(csv(tmp_path, "tau_1,t,gripper,q_1\n1,0,9,2\n3,0.1,9,nan\n"))
    np.testing.assert_array_equal(loaded.position, [[2], [np.nan]])
    np.testing.assert_array_equal(loaded.torque, [[1], [3]])
    assert loaded.warning == "columns that are no channels are ignored: gripper"


def test_uneven_times_are_fine(tmp_path):
    loaded = load_recording(csv(tmp_path, "t,q_1,tau_1\n5,0,0\n5.001,0,0\n7,0,0\n"))
    np.testing.assert_array_equal(loaded.t, [5, 5.001, 7])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("q_1,tau_1\n0,0\n0,0\n", "column t is missing"),
        ("t,tau_1\n0,0\n1,0\n", "column q_1 is missing: channel position"),
        ("t,q_1,q_3,tau_1,tau_2,tau_3\n0,0,0,0,0,0\n", "column q_2 is missing"),
        ("t,q_1,q_2,tau_1\n0,0,0,0\n1,0,0,0\n", "column tau_2 is missing: channel torque"),
        ("t,q_1,dq_1\n0,0,0\n1,0,0\n", "no torque channel: at least one of tau_1, tau_motor_1, tau_cmd_1"),
        ("t,q_1,tau_1\n0,0,0\n1,0,0\n1,0,0\n", "row 3: t is 1 after 1, but time must increase"),
        ("t,q_1,tau_1\n0,0,0\n,0,0\n", "row 2: t is nan"),
        ("t,q_1,tau_1\n0,0,0\n1,inf,0\n", "row 2: q_1 is infinite"),
        ("t,q_1,tau_1\n0,0,0\n1,abc,0\n", "invalid value 'abc'"),
        ("t,q_1,tau_1\n0,0,0\n1,0\n", "row 2: expected 3 columns, got 2"),
        ("t,q_1,q_1,tau_1\n0,0,0,0\n", "'q_1' occurs twice"),
        ("t,q_1,tau_1\n0,0,0\n", "1 rows: a recording needs at least two"),
        ("t,q_1,tau_1\n", "0 rows"),
        ("", "column q_1 is missing"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_line(tmp_path, text, says):
    with pytest.raises(BadInput) as caught:
        load_recording(csv(tmp_path, text))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


def test_files_that_are_no_recordings(tmp_path):
    with pytest.raises(BadInput, match=r"no recording .*nothing.csv"):
        load_recording(tmp_path / "nothing.csv")
    with pytest.raises(BadInput, match=r"not the suffix of a recording, expected .csv, .csv.gz, .parquet, .mcap"):
        load_recording(csv(tmp_path, "", "r.txt"))
    for name in ("r.parquet", "r.mcap", "r.csv.gz"):
        with pytest.raises(BadInput, match="r"):
            load_recording(csv(tmp_path, "not what the suffix says", name))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data(), suffix=st.sampled_from((".csv", ".csv.gz")))
def test_a_table_cut_at_any_byte_loads_up_to_the_cut_and_says_so(recording, tmp_path, data, suffix):
    save_recording(recording, tmp_path / f"r{suffix}")
    whole = (tmp_path / f"r{suffix}").read_bytes()
    cut = data.draw(st.integers(0, len(whole) - 1))
    (tmp_path / f"c{suffix}").write_bytes(whole[:cut])
    text = zlib.decompressobj(31).decompress(whole[:cut]) if suffix == ".csv.gz" else whole[:cut]
    rows = max(0, text.count(b"\n") - 1)
    if rows < 2:
        with contextlib.suppress(BadInput):
            assert load_recording(tmp_path / f"c{suffix}").t.size <= 2
        return
    loaded = load_recording(tmp_path / f"c{suffix}")
    assert loaded.t.size in (rows, rows + 1)  # a last line that is whole but for its end counts
    np.testing.assert_allclose(loaded.position, recording.position[: loaded.t.size], rtol=1e-12)
    np.testing.assert_allclose(loaded.torque, recording.torque[: loaded.t.size], rtol=1e-12)
    line_is_whole = text.endswith(b"\n") or loaded.t.size == rows + 1
    assert f"the first {loaded.t.size} rows were loaded" in loaded.warning or (suffix == ".csv" and line_is_whole)


def test_a_table_written_without_a_last_line_end_is_whole(tmp_path):
    assert load_recording(csv(tmp_path, "t,q_1,tau_1\n0,1.25,2.125\n0.5,1.5,3.250")).t.size == 2
    loaded = load_recording(csv(tmp_path, "t,q_1,tau_1\n0,1.25,2.125\n0.5,1.5,3.25\n1,1,3.2"))
    assert loaded.t.size == 2
    assert "its last line is not complete" in loaded.warning


def test_a_cut_parquet_is_refused_since_its_index_is_at_its_end(recording, tmp_path):
    save_recording(recording, tmp_path / "r.parquet")
    (tmp_path / "r.parquet").write_bytes((tmp_path / "r.parquet").read_bytes()[:-20])
    with pytest.raises(BadInput, match=r"r\.parquet"):
        load_recording(tmp_path / "r.parquet")


def test_a_recording_of_wrong_shape_is_not_saved(recording, tmp_path):
    wrong = Recording(t=recording.t, position=recording.position, torque=recording.torque[:5])
    with pytest.raises(BadInput, match=r"channel torque has shape \(5, 3\), expected \(200, 3\)"):
        save_recording(wrong, tmp_path / "r.csv")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_no_second_table_library_is_imported_to_load_a_table(recording, tmp_path, suffix):
    """Arrow's `to_numpy` imports pandas where it is installed: a quarter of a second, 35 MB."""
    save_recording(recording, tmp_path / f"a{suffix}")
    code = f"import sys; from armlink.recording.files import load_recording; load_recording('a{suffix}')"
    code += "; sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 0


def test_numbers_of_a_column_in_pieces_and_with_gaps():
    whole = pa.array([9.0, 1.0, None, 3.0])
    column = pa.chunked_array([whole.slice(1), pa.array([], pa.float64()), pa.array([4.0, math.nan])])
    np.testing.assert_array_equal(numbers(column), [1.0, math.nan, 3.0, 4.0, math.nan])
    assert numbers(pa.chunked_array([], pa.float64())).shape == (0,)
