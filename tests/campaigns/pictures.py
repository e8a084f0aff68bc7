"""Pictures of the documentation: the daemon's page in Chromium on a simulated arm whose sensor drifts.

python tests/campaigns/pictures.py [--to docs/images] [--arm sarcos]
"""

import argparse
import asyncio
import shutil
import sys
import tempfile
import threading
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

TESTS = Path(__file__).parent.parent
sys.path[:0] = [str(TESTS / "calib" / "daemon" / "web"), str(TESTS / "calib")]

from daemon_bench import DaemonBench  # noqa: E402
from served_page import open_page, served  # noqa: E402

from calib.daemon.settings import DaemonSection  # noqa: E402
from calib.daemon.view import DaemonView  # noqa: E402

LEARN, DRIFT = 240.0, 700.0
"""Simulated seconds as installed, and at most until the drift is found."""
PHONE = {"width": 390, "height": 844}


def main() -> int:
    """Exit status 1 if the drift was not found, so that there is no decision to show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=Path("docs/images"))
    parser.add_argument("--arm", default="sarcos")
    options = parser.parse_args()
    options.to.mkdir(parents=True, exist_ok=True)
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    found: list[DaemonBench] = []
    still = threading.Event()
    with tempfile.TemporaryDirectory() as folder:

        def begin() -> DaemonView:  # on the server's thread, as the journal wants it
            found.append(drifted(Path(folder), options.arm))
            return found[0].view

        async def go_on() -> None:
            while True:
                if not still.is_set():
                    found[0].run(0.1)
                await asyncio.sleep(0.1)

        with served(begin, Path(folder) / "api.sock", go_on) as server, sync_playwright() as playwright:
            if not server.do(lambda: found[0].view.proposals()):
                print("no proposal: the drift was not found", file=sys.stderr)
                return 1
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
            take(open_page(browser, server, 1280), options.to / "daemon.png", still)
            phone = {"is_mobile": True, "has_touch": True, "device_scale_factor": 2}
            take(open_page(browser, server, 390, **phone), options.to / "daemon-phone.png", still, viewport=PHONE)
            decide = open_page(browser, server, 390, **phone)
            take(decide, options.to / "daemon-decision.png", still, ".proposal button.main", PHONE)
            browser.close()
    return 0


def drifted(folder: Path, arm: str) -> DaemonBench:
    """A daemon that has found the drift of a sensor in the arm's middle."""
    bench = DaemonBench(folder, arm, settings=DaemonSection.model_validate({"recording": {"enabled": False}}))
    bench.run(LEARN)
    names = bench.arm.joint_names
    bench.simulated.drift(names[len(names) // 2], 1.03, 0.3)
    for _ in range(round(DRIFT / 20)):
        bench.run(20.0)
        if bench.view.proposals():
            break
    return bench


def take(
    page: Page, path: Path, still: threading.Event, click: str = "", viewport: dict[str, int] | None = None
) -> None:
    """A picture of what is seen first, or of the whole page, while the arm rests and stays `still`."""
    page.wait_for_selector("body[data-shown]")
    if viewport:
        page.set_viewport_size(viewport)  # type: ignore[arg-type]
    page.wait_for_selector("#live svg")
    page.wait_for_timeout(3000)
    page.wait_for_selector("#joints.moving")
    while not page.locator("#joints:not(.moving)").count():  # not even after the last step before it stopped
        still.clear()
        page.wait_for_selector("#joints.moving")
        page.wait_for_selector("#joints:not(.moving)")
        still.set()
        page.wait_for_timeout(300)
    if click:
        page.click(click)
    page.screenshot(path=path, full_page=viewport is None)
    still.clear()
    complaints = page.complaints  # type: ignore[attr-defined]
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB{'; ' + str(complaints) if complaints else ''}")


if __name__ == "__main__":
    sys.exit(main())
