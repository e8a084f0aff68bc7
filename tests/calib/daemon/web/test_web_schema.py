"""schemathesis against the description that the daemon gives of itself: no 5xx, and every answer as described."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from daemon_bench import DaemonBench
from hypothesis import HealthCheck, Phase, given, settings
from served_page import TOKEN, Served, served
from small_arm import small_arm

from calib.daemon.rate_limit import RateLimit
from calib.daemon.service_view import ServiceView

if TYPE_CHECKING:
    import schemathesis

EXAMPLES = 3
"""Generated requests of each kind, valid and not, to each route; tests/campaigns/web.py sends many more."""
SETTINGS = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


def check_all(server: Served, settings: settings) -> set[str]:
    """Generated requests to every route but the stream, which does not end; returns the routes."""
    import schemathesis  # here, since collecting the tests would wait for its two seconds in each process
    from schemathesis.checks import not_a_server_error
    from schemathesis.specs.openapi import checks as described

    conformance = [described.content_type_conformance, described.response_schema_conformance]
    checks = [not_a_server_error, *conformance, described.status_code_conformance]
    headers = {"Authorization": f"Bearer {TOKEN}"}
    schema = schemathesis.openapi.from_dict(server.client().get("/openapi.json").json())
    checked = set()
    for found in schema.exclude(path="/api/stream").get_all_operations():
        operation = found.ok()
        checked.add(f"{operation.method.upper()} {operation.path}")
        for mode in schemathesis.GenerationMode:
            if mode is schemathesis.GenerationMode.NEGATIVE and not takes_anything(operation):
                continue

            @settings
            @given(case=operation.as_strategy(generation_mode=mode))
            def check(case: "schemathesis.Case") -> None:
                case.call_and_validate(server.url, headers=headers, checks=checks)

            check()
    return checked


def takes_anything(operation: "schemathesis.APIOperation") -> bool:
    return any(len(list(part)) for part in (operation.query, operation.path_parameters, operation.headers)) or bool(
        operation.body
    )


@pytest.mark.slow
def test_generated_requests_to_a_whole_daemon_find_no_5xx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RateLimit, "take", lambda *_: 0.0)

    def begin() -> ServiceView:
        bench = DaemonBench(tmp_path, small_arm())
        bench.run(3.0)
        bench.service.save(history=True)
        bench.service.events.say("drift", "elbow", "gain", {"value": float("inf")})
        return bench.view

    with served(begin, tmp_path / "api.sock") as server:
        checked = check_all(server, SETTINGS)
    reading = ("status", "overview", "joints", "estimates", "external", "events", "history", "proposals", "arm")
    wanted = {f"GET /api/{name}" for name in reading}
    decisions = {f"POST /api/proposals/{{id}}/{verb}" for verb in ("approve", "reject")}
    wanted |= {f"GET /api/window{suffix}" for suffix in ("", ".csv", ".mcap")}
    assert checked == wanted | decisions | {"GET /api/report", "GET /metrics"}
