"""The last minutes of readings over the API: three forms of the same rows, in pieces, and bounded."""

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from daemon_bench import DaemonBench
from made_up_view import NAMES, MadeUpView
from mcap.reader import make_reader
from served_page import Served
from small_arm import small_arm

from armlink.recording.files import load_recording
from armlink.recording.ros_joint_state import JointStateDecoder
from calib.daemon.web.history import PIECE, csv_lines, mcap_pieces


def test_json_csv_and_mcap_are_the_same_rows(server: Served, view: MadeUpView, tmp_path: Path) -> None:
    server.do(lambda: setattr(view, "t", 90.0))
    client = server.client()
    rows = client.get("/api/window?seconds=60").json()
    assert (tuple(rows["joints"]), len(rows["t"]), rows["t"][-1]) == (NAMES, 601, 60.0)
    assert rows["temperature"][0][:2] == [None, 32.0]
    for suffix in ("csv", "mcap"):
        answer = client.get(f"/api/window.{suffix}?seconds=60")
        begin = datetime.fromisoformat(rows["time"]).timestamp() - 60.0
        stamp = datetime.fromtimestamp(begin, datetime.fromisoformat(rows["time"]).tzinfo).strftime("%Y%m%dT%H%M%SZ")
        assert f'filename="armlink-{stamp}.{suffix}"' in answer.headers["content-disposition"]
        (tmp_path / f"window.{suffix}").write_bytes(answer.content)
        run = load_recording(tmp_path / f"window.{suffix}")
        np.testing.assert_allclose(run.t, rows["t"], atol=1e-6)
        for channel in ("position", "torque", "temperature"):
            np.testing.assert_allclose(getattr(run, channel), np.array(rows[channel], dtype=float), rtol=1e-6)


def test_the_models_torque_goes_along(server: Served, view: MadeUpView, tmp_path: Path) -> None:
    server.do(lambda: setattr(view, "t", 5.0))
    client = server.client()
    model = np.array(client.get("/api/window").json()["model_torque"])
    lines = client.get("/api/window.csv").text.splitlines()
    assert lines[0].split(",")[-1] == "model_7"
    np.testing.assert_allclose([float(line.split(",")[-1]) for line in lines[1:]], model[:, -1], rtol=1e-5, atol=1e-6)
    (tmp_path / "window.mcap").write_bytes(client.get("/api/window.mcap").content)
    with (tmp_path / "window.mcap").open("rb") as stream:
        found = [JointStateDecoder()(m.data).effort for _, _, m in make_reader(stream).iter_messages("/model_torques")]
    np.testing.assert_allclose(found, model, rtol=1e-12)


@pytest.mark.parametrize(
    ("query", "says"),
    [("seconds=601", "600"), ("seconds=0", "greater"), ("limit=1", "2"), ("from=now", "no parameter")],
)
def test_a_window_that_is_not_kept_is_refused(server: Served, query: str, says: str) -> None:
    for suffix in ("", ".csv", ".mcap"):
        answer = server.client().get(f"/api/window{suffix}?{query}")
        assert answer.status_code == 422
        assert says in answer.json()["error"]


def test_thinned_rows_are_even_and_end_now(server: Served, view: MadeUpView) -> None:
    server.do(lambda: setattr(view, "t", 400.0))
    rows = server.client().get("/api/window?limit=100").json()
    assert len(rows["t"]) == 100
    np.testing.assert_allclose(np.diff(rows["t"]), 400 / 99, atol=2e-3)


def test_long_answers_leave_in_pieces(view: MadeUpView) -> None:
    view.t = 600.0
    window = view.window(600.0, 6001)
    for pieces in (list(mcap_pieces(window)), [line.encode() for line in csv_lines(window)]):
        assert len(pieces) > 2
        assert max(map(len, pieces)) <= 2 * PIECE
    view.begin()


def test_a_daemon_without_a_bus_answers_with_no_rows(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, small_arm(), records=False)
    window = bench.view.window(600.0, 100)
    assert (len(window.t), window.channels["torque"].shape) == (0, (0, 3))
    assert "".join(csv_lines(window)) == "t,q_1,q_2,q_3,tau_1,tau_2,tau_3\n"
    assert b"".join(mcap_pieces(window))


def test_a_daemon_keeps_what_its_joints_read(tmp_path: Path) -> None:
    bench = DaemonBench(tmp_path, small_arm())
    bench.run(20.0)
    window, now = bench.view.window(10.0, 1000), bench.view.joints()
    assert len(window.t) == pytest.approx(101, abs=2)
    np.testing.assert_allclose(np.diff(window.t), 0.1, atol=0.011)
    assert abs((window.time - bench.view.status().time).total_seconds()) < 0.2
    for channel in ("position", "torque", "model_torque"):
        np.testing.assert_allclose(window.channels[channel][-1], [getattr(each, channel) for each in now])
    single = bench.service.records.feed.observer.model_torque(window.channels["position"][3])
    np.testing.assert_allclose(window.channels["model_torque"][3], single, rtol=1e-12)
    drawn = bench.view.arm()
    assert [each.joint for each in drawn.joints] == [each.joint for each in now]
