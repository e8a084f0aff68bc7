"""The page in real Chromium: the whole daemon on the simulated arm through a drift and a fault; small views besides."""

import asyncio
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import pytest
from daemon_bench import DaemonBench
from made_up_view import NAMES, NOW, MadeUpView
from playwright.sync_api import Browser, Locator, Page, expect
from served_page import TOKEN, Served, open_page, served
from small_arm import small_arm

from armlink.recording.files import load_recording
from calib.daemon.settings import DaemonSection
from calib.daemon.view import HistoryPoint, State
from calib.records.records import CalibrationRecord

PATIENCE = 60_000
"""Playwright's own waits end here [ms]; nothing waits so long where the machine is not overloaded."""
QUICK = {"window": 12, "baseline_rows": 24}


@dataclass
class Simulated:
    """A daemon on the simulated arm whose time runs as fast as the machine can, while `goes`."""

    bench: DaemonBench
    server: Served
    goes: bool = True

    def do(self, act):  # type: ignore[no-untyped-def]
        return self.server.do(lambda: act(self.bench))


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Simulated]:
    found: list[DaemonBench] = []
    section = {"policy": "propose", "recording": {"enabled": False}, "observer": QUICK}

    def begin():  # type: ignore[no-untyped-def]
        bench = DaemonBench(tmp_path, small_arm(), settings=DaemonSection.model_validate(section))
        bench.run(60.0)  # the observer learns how the sensors read as they were installed
        found.append(bench)
        return bench.view

    async def go_on() -> None:
        while True:
            for _ in range(30):  # requests are answered between the seconds
                await asyncio.sleep(0)
            if simulated.goes:
                found[0].run(1.0)

    simulated = Simulated(None, None)  # type: ignore[arg-type]
    with served(begin, tmp_path / "api.sock", go_on) as server:
        simulated.bench, simulated.server = found[0], server
        yield simulated


@pytest.mark.long
@pytest.mark.slow
def test_through_a_drift_and_a_fault(browser: Browser, daemon: Simulated) -> None:
    page = open_page(browser, daemon.server)
    page.set_default_timeout(PATIENCE)
    expect.set_options(timeout=PATIENCE)
    expect(page.locator("#state")).to_have_text("observing")
    expect(page.locator("#joints tbody tr")).to_have_count(3)
    expect(page.locator("[data-bus=rate_hz] dd")).to_have_text("100 Hz")
    values_change(page)
    a_drift_appears(page, daemon)
    a_proposal_is_approved(page, daemon)
    a_bus_fault_shows(page, daemon)
    assert page.complaints == []


def values_change(page: Page) -> None:
    position = page.locator("[data-joint=shoulder] .position")
    before = position.inner_text()
    expect(position).not_to_have_text(before)
    assert re.fullmatch(r"−?\d\.\d{3}", before)


def a_drift_appears(page: Page, daemon: Simulated) -> None:
    daemon.do(lambda bench: bench.simulated.drift("shoulder", 1.03, 0.3))
    expect(page.locator("#events li.drift[data-kind=drift]").first).to_contain_text("shoulder")
    expect(page.locator(".proposal .what")).to_contain_text(re.compile(r"shoulder has drifted: gain [+]\d\.\d\d ±"))
    expect(page.locator("tr[data-joint=shoulder]")).to_have_class(re.compile("drifting"))
    expect(page.locator("#state")).to_have_text("DECISION NEEDED")
    expect(page.locator("#detail")).to_contain_text("shoulder")
    expect(page.locator("#chart-shoulder svg line.event.drift").first).to_be_attached()
    expect(page.locator("#timeline circle.drift").first).to_be_attached()
    assert daemon.do(lambda bench: bench.host.controllers.read_calibration(1).gain) == pytest.approx(
        daemon.bench.truth.gain[1], rel=1e-3
    )


def a_proposal_is_approved(page: Page, daemon: Simulated) -> None:
    daemon.goes = False  # else a newer proposal takes its place before a busy machine's browser has decided
    proposal = daemon.do(lambda bench: bench.view.proposals()[0])
    record = proposal.record
    page.click(f".proposal[data-proposal='{proposal.id}'] button.main")
    page.fill("#by", "ann")
    with page.expect_response(lambda response: response.request.method == "POST"):
        page.click("#decision-yes")
    daemon.goes = True
    expect(page.locator("#decided-list li", has_text="shoulder").first).to_contain_text("applied")
    expect(page.locator("#decided-list li", has_text="shoulder").first).to_contain_text("ann (tcp 127.0.0.1)")
    expect(page.locator("#events li[data-kind=recalibration]").first).to_contain_text("shoulder")
    expect(page.locator("#records")).to_contain_text(record)
    expect(page.locator("#proposals")).to_be_hidden()
    expect(page.locator("tr[data-joint=shoulder]")).not_to_have_class(re.compile("drifting"))
    held = daemon.do(lambda bench: bench.host.controllers.read_calibration(1))
    assert held.gain / daemon.do(lambda bench: bench.simulated.true_sensors.gain[1]) == pytest.approx(1.0, abs=0.003)
    current = daemon.do(lambda bench: bench.store.current(CalibrationRecord, bench.arm))
    assert (current.id, current.number) == (record, held.record_id)


def a_bus_fault_shows(page: Page, daemon: Simulated) -> None:
    def pull(bench: DaemonBench) -> None:
        bench.bus_there = False
        bench.host.close()

    daemon.do(pull)
    expect(page.locator("#state")).to_have_text("FAULT")
    expect(page.locator("#detail")).to_contain_text("cannot open it: No such device")
    expect(page.locator("[data-bus=connected] dd")).to_have_text("silent")
    expect(page.locator("#events li.fault").first).to_contain_text("No such device")
    expect(page.locator("[data-joint=base] .drive.is-bad")).to_be_attached()
    daemon.do(lambda bench: setattr(bench, "bus_there", True))
    expect(page.locator("#state")).to_have_text("observing")


def test_the_token_is_asked_for_once(browser: Browser, server: Served) -> None:
    page = open_page(browser, server, token="not-the-token")
    expect(page.locator("#token-error")).to_have_text("This token is wrong.")
    page.fill("#token", TOKEN)
    page.click("#ask-token button")
    expect(page.locator("#state")).to_have_text("observing")
    page.reload()
    expect(page.locator("#state")).to_have_text("observing")
    expect(page.locator("#ask-token")).to_be_hidden()
    page.click("#forget")
    expect(page.locator("#ask-token")).to_be_visible()


def test_one_document_and_one_answer_show_everything(browser: Browser, server: Served, view: MadeUpView) -> None:
    context = browser.new_context()
    context.add_init_script(f"localStorage.setItem('armlink-token', '{TOKEN}')")
    page, asked = context.new_page(), []
    page.on("request", lambda request: asked.append(request.url.removeprefix(server.url).partition("?")[0]))
    page.goto(server.url)
    page.wait_for_selector("body[data-shown]")
    expect(page.locator("#joints tbody tr")).to_have_count(len(NAMES))
    before_the_stream = [path for path in asked if path.startswith("/")]
    assert before_the_stream[:3] in (["/", "/api/overview"], ["/", "/api/overview", "/api/stream"])


@pytest.mark.sample(1)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone(browser: Browser, server: Served, view: MadeUpView, scheme: str) -> None:
    server.do(view.propose)
    server.do(lambda: view.happen("fault", "joint_3", "joint_3 (node 3): emergency 8130h, life guard error " * 3))
    page = open_page(browser, server, 390, color_scheme=scheme, has_touch=True, is_mobile=True)
    expect(page.locator("#charts .chart")).to_have_count(7)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    wide = "[...document.querySelectorAll('main *')].filter(e => e.getBoundingClientRect().right > 391).length"
    assert page.evaluate(wide) == 0
    button = page.locator(".proposal button.main").bounding_box()
    assert button is not None
    assert button["height"] >= 40
    page.click(".proposal button:not(.main)")
    page.click("#decision-yes")
    expect(page.locator("#decided-list")).to_contain_text("rejected")
    assert page.complaints == []


def test_history_has_intervals_and_events_on_one_time_axis(browser: Browser, server: Served, view: MadeUpView) -> None:
    def fill() -> None:
        for k in range(0, 600, 20):
            for j, name in enumerate(NAMES):
                gain, at = 1 + 0.01 * (j == 1 and k > 300), NOW + timedelta(seconds=k)
                offsets = {"offset": 0.0, "offset_std": 0.01}
                view.points.append(
                    HistoryPoint(time=at, t=k, joint=name, gain=gain, gain_std=0.001, record="a", **offsets)
                )
        view.t = 300.0
        view.happen("payload", None, "1.2 kg picked up", mass=1.2)
        view.t = 600.0

    server.do(fill)
    page = open_page(browser, server)
    chart = page.locator("#chart-joint_2 svg")
    expect(chart.locator("polygon.band")).to_have_count(4)  # gain and offset; the estimate of now is of another record
    expect(chart.locator("line.event.load title")).to_contain_text("1.2 kg picked up")
    at_event = float(chart.locator("line.event.load").get_attribute("x1") or "nan")
    first_line = chart.locator("polyline.gain").first.get_attribute("points") or ""
    times = [float(point.split(",")[0]) for point in first_line.split()]
    assert min(times) < at_event < max(times)
    assert at_event == pytest.approx(times[15], abs=1.0)  # the point of the same 300 s
    same = [card.get_attribute("x1") for card in page.locator("#charts line.event.load").all()]
    assert len(set(same)) == 1
    expect(page.locator("#ranges [data-seconds='600']")).to_have_attribute("aria-pressed", "true")
    earlier = [point.model_copy(update={"time": NOW - timedelta(seconds=1800)}) for point in view.points[: len(NAMES)]]
    server.do(lambda: view.points.__setitem__(slice(0, 0), earlier))
    page.click("#ranges [data-seconds='3600']")
    expect(page.locator("#ranges [data-seconds='3600']")).to_have_attribute("aria-pressed", "true")
    expect(chart.locator("polyline.gain").first).not_to_have_attribute("points", first_line)


def test_states_and_missing_readings_are_said_big(browser: Browser, server: Served, view: MadeUpView) -> None:
    page = open_page(browser, server)
    expect(page.locator("#detail")).to_contain_text("joint_2")

    def set_to(state: State, fault: str | None = None) -> None:
        view.state, view.fault = state, fault
        view.tick()

    for state in (State.SWEEPING, State.RECALIBRATING, State.STARTING):
        server.do(lambda state=state: set_to(state))
        expect(page.locator("#state")).to_have_text(state.value)
        expect(page).to_have_title(re.compile(state.value))
    server.do(lambda: set_to(State.FAULT, "joint_3: no reading for 2.0 s"))
    expect(page.locator("#state")).to_have_text("FAULT")
    expect(page.locator("#detail")).to_have_text("joint_3: no reading for 2.0 s")
    expect(page.locator("[data-joint=joint_3] .drive")).to_have_text("no readings")
    assert page.locator("#state").evaluate("e => parseFloat(getComputedStyle(e).fontSize)") >= 24


def test_a_text_from_the_bus_is_never_markup(browser: Browser, server: Served, view: MadeUpView) -> None:
    nasty = "<img src=x onerror=alert(1)>"
    server.do(lambda: view.happen("fault", nasty, nasty, said=nasty))
    page = open_page(browser, server)
    expect(page.locator("#events .text").first).to_contain_text(nasty)
    expect(page.locator("#events img")).to_have_count(0)


@pytest.mark.long
def test_a_daemon_that_goes_is_missed_and_found_again(browser: Browser, tmp_path: Path) -> None:
    view = MadeUpView()
    with served(lambda: view, tmp_path / "api.sock") as server:
        page = open_page(browser, server)
        expect(page.locator("#state")).to_have_text("observing")
    expect(page.locator("#state")).to_have_text("NO CONNECTION")
    expect(page.locator("#detail")).to_contain_text("The values below are old")


def test_live_torque_beside_the_model_and_its_window_as_a_recording(
    browser: Browser, server: Served, view: MadeUpView, tmp_path: Path
) -> None:
    page = open_page(browser, server)
    expect(page.locator("#joints tbody tr")).to_have_count(len(NAMES))

    def tick_until(shown: str) -> None:
        for _ in range(200):
            server.do(view.tick)
            page.wait_for_timeout(20)
            if page.locator(shown).count():
                return

    tick_until("#joints.moving")  # the made-up arm swings
    tick_until("#live-joint_7 svg polyline.torque")
    expect(page.locator("#joints")).to_have_class("moving")
    expect(page.locator("[data-joint=joint_3] .external")).to_have_text("+0.10 ± 0.40")
    expect(page.locator("#moving")).to_contain_text("when it rests")
    expect(page.locator("#live .chart")).to_have_count(len(NAMES))
    expect(page.locator("#live-joint_1 svg")).to_have_attribute(
        "aria-label", re.compile(r"joint_1: sensor .* model .* N·m")
    )
    drawn = page.locator("#live-joint_1 svg polyline").evaluate_all(
        "all => all.map(e => [e.classList.value.split(' ')[1], parseFloat(getComputedStyle(e).strokeWidth)])"
    )
    (below, wide), (above, thin) = drawn[0], next(each for each in reversed(drawn) if "torque" in each[0])
    assert (below, above) == ("torque", "model_torque")  # the model is seen where it agrees with the sensor
    assert wide > 2 * thin
    for suffix, seconds in (("csv", 60), ("mcap", 600)):
        page.click(f"#live-ranges [data-seconds='{seconds}']")
        with page.expect_download() as got:
            page.click(f"#download-{suffix}")
        assert got.value.suggested_filename.endswith(f".{suffix}")
        got.value.save_as(tmp_path / f"window.{suffix}")
        run = load_recording(tmp_path / f"window.{suffix}")
        assert run.torque is not None
        assert run.torque.shape[1] == len(NAMES)
        assert run.t[-1] == pytest.approx(min(seconds, server.do(lambda: view.t)), abs=1.0)
    assert page.complaints == []


@pytest.mark.long
def test_it_opens_on_what_was_before_it(browser: Browser, server: Served, view: MadeUpView) -> None:
    server.do(lambda: setattr(view, "t", 250.0))
    page = open_page(browser, server)
    chart = page.locator("#live-joint_1 svg")
    expect(chart.locator("text", has_text="−4.2 min")).to_have_count(1)
    times = [float(point.split(",")[0]) for point in points_of(chart)]
    assert times[0] < 60
    assert times[-1] > chart.bounding_box()["width"] - 20  # type: ignore[index]
    tops = [float(point.split(",")[1]) for point in points_of(chart)]
    assert max(tops) - min(tops) > 40  # no peak is lost in drawing few points
    axis = page.locator("#chart-joint_1 svg text").all_text_contents()
    assert "08:00" in axis  # since the start, four minutes ago, and not the ten that were asked for
    assert "07:56" not in axis


def points_of(chart: Locator) -> list[str]:
    return (chart.locator("polyline.torque").first.get_attribute("points") or "").split()


def test_a_decision_shows_its_evidence(browser: Browser, server: Served, view: MadeUpView) -> None:
    server.do(view.propose)
    page = open_page(browser, server, 390, is_mobile=True, has_touch=True)
    page.click(".proposal button.main")
    shown = page.locator("#decision-evidence")
    for word in ("change", "rests of the arm", "confidence", "record"):
        expect(shown).to_contain_text(word)
    expect(shown.locator("svg")).to_have_count(1)
    box = page.locator("#ask-decision").bounding_box()
    assert box is not None
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 390
    page.click("#decision-no")


def test_what_touches_the_arm(browser: Browser, server: Served, view: MadeUpView) -> None:
    page = open_page(browser, server)
    force, moment = (page.locator(f"[data-wrench={name}] td") for name in ("force", "moment"))
    expect(force).to_have_text(["+0.4 ± 1.6", "−0.2 ± 1.4", "+1.1 ± 2.4"])
    expect(moment).to_have_text(["–", "+0.1 ± 0.4", "−0.1 ± 0.2"])
    expect(page.locator("#touch-frame")).to_have_text("at joint_7")
    expect(page.locator("#no-contacts")).to_be_visible()
    expect(page.locator("#link")).to_contain_text("live")
    server.do(view.touch)
    expect(page.locator("#contacts li")).to_have_count(1)
    expect(page.locator("#contacts li")).to_contain_text(
        "contact: on link joint_4 (82 %), at least 9.4 N; joints joint_2, joint_1"
    )
    view.shift = 1.0

    def pushed() -> bool:
        server.do(view.tick)
        page.wait_for_timeout(20)
        return force.first.text_content() == "+40.4 ± 1.6"

    assert any(pushed() for _ in range(200))
    expect(force.first).to_have_class(re.compile("off"))
    page.reload()
    expect(page.locator("#contacts li")).to_have_count(1)
    assert page.complaints == []
