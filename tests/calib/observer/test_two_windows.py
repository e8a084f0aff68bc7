"""Two windows that agree on a drift, and all their rows together that do not."""

from dataclasses import replace

import pytest
from observed_stops import Bench, kinds


@pytest.mark.parametrize("other", [{"joint": 4}, {"cause": "slip"}])
def test_what_all_windows_together_do_not_say_is_not_proposed(sarcos, sarcos_beta, monkeypatch, other):
    bench = Bench(sarcos, sarcos_beta, 1)
    bench.work(20)
    asked = []
    tested = bench.observer._cause_test

    def cause_test(rows):
        test = tested(rows)
        if len(rows) > bench.observer.config.window:
            asked.append(len(rows))
            verdict = replace(test.verdict(), **other)
            monkeypatch.setattr(test, "verdict", lambda: verdict)
        return test

    monkeypatch.setattr(bench.observer, "_cause_test", cause_test)
    bench.drift(2, gain=1.03, offset=0.3)
    events = bench.work(50)
    assert asked
    assert "proposal" not in kinds(events)
    reasons = [event.evidence["reasons"] for event in events if event.kind == "undecided"]
    assert [
        "each window of readings shows a drift of the sensor, but all windows together show another cause"
    ] in reasons
