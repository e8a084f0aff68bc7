"""The API: every route, its form, and one clear error for what cannot be used."""

import json
import re
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from made_up_view import NAMES, NOW, MadeUpView
from prometheus_client.parser import text_string_to_metric_families
from pydantic import TypeAdapter, ValidationError
from served_page import Served

from calib.daemon.view import HistoryPoint
from calib.daemon.web import history, routes
from calib.daemon.web import server as page_module
from calib.daemon.web.history import LARGEST_ID, Id
from calib.daemon.web.server import PAGE
from calib.daemon.web.stream import Streams


def test_status_says_what_the_contract_lists(server: Served) -> None:
    status = server.client().get("/api/status").json()
    assert {"state", "arm", "serial", "version", "uptime_s", "bus", "records"} <= status.keys()
    assert status["state"] in ("starting", "observing", "sweeping", "recalibrating", "fault")
    assert {"rate_hz", "load", "frames", "missed", "errors"} <= status["bus"].keys()
    assert status["records"].keys() == {"calibration", "gravity"}
    assert status["time"].endswith("Z")


def test_ids_are_those_that_the_journal_can_hold() -> None:
    ids = TypeAdapter(Id)
    with closing(sqlite3.connect(":memory:")) as db:
        assert db.execute("SELECT ?", (ids.validate_python(LARGEST_ID),)).fetchone() == (LARGEST_ID,)
        with pytest.raises(OverflowError):
            db.execute("SELECT ?", (LARGEST_ID + 1,))
    with pytest.raises(ValidationError):
        ids.validate_python(LARGEST_ID + 1)


def test_joints_and_estimates_are_lists_base_to_tip(server: Served) -> None:
    client = server.client()
    joints, estimates = client.get("/api/joints").json(), client.get("/api/estimates").json()
    assert [one["joint"] for one in joints] == [one["joint"] for one in estimates] == list(NAMES)
    assert {"position", "torque", "model_torque", "residual", "state", "sample_age_s"} <= joints[0].keys()
    assert {"gain", "gain_std", "offset", "offset_std", "samples", "last_accepted"} <= estimates[0].keys()


def test_events_come_after_an_id(server: Served, view: MadeUpView) -> None:
    for number in range(5):
        server.do(lambda number=number: view.happen("drift", "joint_2", f"number {number}", gain=1.01))
    client = server.client()
    assert [event["id"] for event in client.get("/api/events").json()] == [1, 2, 3, 4, 5]
    (event,) = client.get("/api/events", params={"after": 2, "limit": 1}).json()
    assert (event["id"], event["kind"], event["joint"], event["evidence"]) == (3, "drift", "joint_2", {"gain": 1.01})
    assert client.get("/api/events?after=99").json() == []


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("joint=joint_1&from=&to=", [0, 60, 120]),
        ("joint=joint_1&from=2026-05-01T08:01:00Z", [60, 120]),
        ("joint=joint_1&to=2026-05-01T10:01:00%2B02:00", [0, 60]),
        ("joint=joint_1&to=2026-05-01T10:01:00+02:00", [0, 60]),
        ("", [0, 60, 120] * 7),
    ],
    ids=["open", "from", "to", "a plus sent as a space", "every joint"],
)
def test_history_between_times(server: Served, view: MadeUpView, query: str, expected: list[float]) -> None:
    def point(joint: str, t: float) -> HistoryPoint:
        at = NOW.replace(minute=int(t // 60))
        return HistoryPoint(time=at, t=t, joint=joint, gain=1, gain_std=0, offset=0, offset_std=0, record=None)

    server.do(lambda: view.points.extend(point(joint, t) for t in (0.0, 60.0, 120.0) for joint in NAMES))
    assert [point["t"] for point in server.client().get(f"/api/history?{query}").json()] == expected


def test_a_proposal_is_decided_once_and_by_somebody(server: Served, view: MadeUpView) -> None:
    server.do(view.propose)
    server.do(view.propose)
    client = server.client()
    approved = client.post("/api/proposals/1/approve", json={"by": "ann"}).json()
    assert approved["state"] == "approved"
    assert approved["decided_by"].startswith("ann (")
    assert "uid " in approved["decided_by"]
    rejected = client.post("/api/proposals/2/reject").json()
    assert (rejected["state"], "on the socket" in rejected["decided_by"]) == ("rejected", True)
    again = client.post("/api/proposals/1/reject")
    assert (again.status_code, again.json()) == (409, {"error": "proposal 1 is already approved"})
    assert client.post("/api/proposals/9/approve").status_code == 404
    assert [one["state"] for one in client.get("/api/proposals").json()] == ["rejected", "approved"]


def test_a_decision_may_name_the_content_and_is_then_of_that_alone(server: Served, view: MadeUpView) -> None:
    server.do(view.propose)
    client = server.client()
    (shown,) = client.get("/api/proposals").json()
    other = client.post("/api/proposals/1/approve", json={"hash": "0" * 64})
    assert other.status_code == 409
    assert "does not have the hash" in other.json()["error"]
    assert client.post("/api/proposals/1/approve", json={"hash": "1"}).status_code == 422
    assert client.post("/api/proposals/1/approve", json={"hash": shown["hash"], "by": "ann"}).status_code == 200


def test_a_decision_that_is_not_on_disk_in_time_is_not_yet_and_stands(
    server: Served, view: MadeUpView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(routes, "DISK_SECONDS", 0.05)
    server.do(view.propose)
    view.disk_hangs = True
    answer = server.client().post("/api/proposals/1/approve")
    assert answer.status_code == 503
    assert answer.json()["error"].startswith("the decision on proposal 1 waits for the disk")
    assert server.client().post("/api/proposals/1/approve").status_code == 409


def test_events_that_the_disk_does_not_give_are_given_up(
    server: Served, view: MadeUpView, monkeypatch: pytest.MonkeyPatch
) -> None:
    may = threading.Event()
    monkeypatch.setattr(history, "DISK_SECONDS", 0.05)
    monkeypatch.setattr(view, "events", lambda after=0, limit=500: may.wait(60) and ())
    answer = server.client().get("/api/events")
    assert (answer.status_code, server.client().get("/api/status").status_code) == (503, 200)
    assert "the disk has not answered" in answer.json()["error"]
    may.set()


@pytest.mark.parametrize(
    ("method", "path", "status", "says"),
    [
        ("GET", "/api/events?after=-1", 422, "after"),
        ("GET", "/api/events?after=9223372036854775808", 422, "after"),
        ("GET", "/api/events?afer=1", 422, "afer: there is no parameter of this name"),
        ("GET", "/api/history?joint=elbow", 404, "joint_1, joint_2"),
        ("GET", "/api/history?joint=a%00b", 404, "no joint"),
        ("GET", "/api/history?from=yesterday", 422, "from"),
        ("GET", "/api/history?from=2026-05-01T08:00:00", 422, "timezone"),
        ("GET", "/api/history?from=0001-01-01T00:00:00%2B14:00", 422, "between 1970 and 2999"),
        (
            "GET",
            "/api/history?from=2026-05-02T00:00:00Z&to=2026-05-01T00:00:00Z",
            422,
            "parameter `from` must not be later than parameter `to`",
        ),
        ("GET", "/api/proposals/0/approve", 405, "GET is not allowed"),
        ("POST", "/api/proposals/0/approve", 422, "id"),
        ("POST", "/api/proposals/one/approve", 422, "id"),
        ("POST", "/api/status", 405, "POST is not allowed"),
        ("GET", "/api/stream?after=x", 422, "after"),
        ("GET", "/api/torque", 404, "/api/torque"),
        ("GET", "/static/../app.py", 404, "there is no"),
        ("GET", "/api/report", 404, "no report yet"),
    ],
)
def test_bad_input_is_one_clear_error(server: Served, method: str, path: str, status: int, says: str) -> None:
    answer = server.client().request(method, path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/json"
    assert answer.json().keys() == {"error"}
    assert says in answer.json()["error"]
    assert "\n" not in answer.json()["error"]


@pytest.mark.parametrize("body", ["{", "[]", '{"by": ""}', '{"by": "a\\nb"}', '{"torque": 3}', "\xff"])
def test_a_body_that_cannot_be_used_decides_nothing(server: Served, view: MadeUpView, body: str) -> None:
    server.do(view.propose)
    headers = {"content-type": "application/json"}
    answer = server.client().post("/api/proposals/1/approve", content=body.encode("latin-1"), headers=headers)
    assert answer.status_code in (400, 422)
    assert answer.json().keys() == {"error"}
    assert server.do(lambda: view.offered[0].state) == "pending"


def test_the_overview_is_what_the_other_routes_say(server: Served, view: MadeUpView) -> None:
    for number in range(5):
        server.do(lambda number=number: view.happen("drift", "joint_2", f"number {number}", gain=1.01))
    server.do(view.propose)
    client = server.client()
    all_of_it = client.get("/api/overview", params={"seconds": 0, "events": 3}).json()
    for name in ("joints", "estimates", "proposals", "history"):
        assert all_of_it[name] == client.get(f"/api/{name}").json()
    assert all_of_it["status"].keys() == client.get("/api/status").json().keys()
    last = all_of_it["status"]["last_event"]
    assert [event["id"] for event in all_of_it["events"]] == [last - 2, last - 1, last]


def test_a_failure_inside_shows_no_traceback(server: Served, view: MadeUpView, monkeypatch: Any) -> None:
    def broken() -> None:
        raise RuntimeError("a secret of the inside")

    monkeypatch.setattr(view, "estimates", broken)
    answer = server.client().get("/api/estimates")
    assert answer.status_code == 500
    assert answer.json() == {"error": "internal error; see the log of the daemon"}


def test_nothing_commands_torque_or_motion(server: Served, view: MadeUpView) -> None:
    """Read is separate from control: by the description, by the routes there are, and by what the view offers."""
    from calib.daemon.view import DaemonView
    from calib.daemon.web.server import open_app

    described = server.client().get("/openapi.json").json()["paths"]
    writing = {(path, method) for path, methods in described.items() for method in methods if method != "get"}
    assert writing == {("/api/proposals/{id}/approve", "post"), ("/api/proposals/{id}/reject", "post")}
    bodies = json.dumps([described[path][method].get("requestBody") for path, method in writing])
    assert "Decision" in bodies
    app = open_app(view, Streams(view))
    known = {*described, "/openapi.json", PAGE}
    assert all(path in known for path in route_paths(app.routes))
    offered = {name for name in vars(DaemonView) if not name.startswith("_")}
    reading = {"status", "joints", "estimates", "external", "events", "history_pages", "proposals", "subscribe"}
    assert offered == reading | {"arm", "window"} | {"approve", "reject"}


def route_paths(routes: Any) -> set[str]:
    return {route.path for route in routes if hasattr(route, "path")}


def test_every_route_of_the_contract_is_described_and_typed(server: Served) -> None:
    described = server.client().get("/openapi.json").json()
    wanted = ("status", "overview", "joints", "arm", "estimates", "external", "events", "history", "window")
    wanted += ("proposals", "stream")
    assert {f"/api/{name}" for name in wanted} | {"/metrics"} <= described["paths"].keys()
    for name in wanted[:-1]:
        schema = described["paths"][f"/api/{name}"]["get"]["responses"]["200"]["content"]["application/json"]["schema"]
        assert "$ref" in json.dumps(schema)
    assert {"JointsItem", "EventItem", "ApiError"} <= described["components"]["schemas"].keys()


def test_metrics_are_prometheus_text_and_documented(server: Served, view: MadeUpView) -> None:

    server.do(lambda: view.happen("fault", None, "a fault"))
    answer = server.client().get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain")
    families = {family.name: family for family in text_string_to_metric_families(answer.text)}
    value = {(s.name, *s.labels.values()): s.value for family in families.values() for s in family.samples}
    assert value["armlink_state", "observing"] == 1
    assert value["armlink_state", "fault"] == 0
    assert value["armlink_sensor_gain_ratio", "joint_2"] == pytest.approx(1.012)
    assert value[("armlink_events_total",)] == 1
    page = (Path(__file__).parents[4] / "docs" / "daemon-api.md").read_text()
    ours = {sample.name for family in families.values() for sample in family.samples if "armlink" in sample.name}
    assert [name for name in sorted(ours) if name not in page] == []


def test_the_report_may_ask_nobody_anything(server: Served, view: MadeUpView, tmp_path: Any) -> None:
    report = tmp_path / "report.html"
    report.write_text("<h1>A report</h1>")
    server.do(lambda: setattr(view, "report", report))
    answer = server.client().get("/api/report")
    assert answer.text == "<h1>A report</h1>"
    assert "sandbox" in answer.headers["content-security-policy"]
    assert "connect-src" not in answer.headers["content-security-policy"]


def test_the_page_s_script_has_every_module_once_and_before_its_users() -> None:
    static = {path.name: path.read_text() for path in Path(page_module.__file__).with_name("static").glob("*.js")}
    script = page_module.joined("page.js")
    heads = {name: text.partition("\n")[0] for name, text in static.items()}
    assert {name: script.count(head) for name, head in heads.items()} == dict.fromkeys(static, 1)
    for name, text in static.items():
        for other in re.findall(r'from "\./(.*)";', text):
            assert script.index(heads[other]) < script.index(heads[name])
    assert not re.search(r"^(import|export) ", script, re.MULTILINE)


def test_the_page_comes_from_here_alone(server: Served) -> None:
    client = server.client()
    page = client.get("/")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "http" not in policy
    files: Callable[[str], Any] = client.get
    answer = files(PAGE)
    assert answer.status_code == 200
    assert "://" not in answer.text.replace("http://www.w3.org/", "")
    assert client.get(PAGE, headers={"if-none-match": answer.headers["etag"]}).status_code == 304
