"""Campaign: the way a newcomer goes: every command block of the pages below, in order, in real time, on a short arm.

    python tests/campaigns/docs_walk.py [--out DIR] [--group 7]

`my-arm.yaml` is a two-joint arm on udp_multicast, and stands for `sarcos` and `arm.yaml` too; the simulated arm runs in
a process of its own, as in the second terminal of first-run.md. Ids of records and names of buses are replaced by those
that there are. Prints a line a command; exit status 1 where one does not end as the page says. What is left out is in
LEFT_OUT, with the reason; a line that is neither run nor there is a failure.
"""

import argparse
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from http.client import HTTPConnection
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from small_pair import FALSE, SEED, describe, simulated

ROOT = Path(__file__).parents[2]
PAGES = ("first-run", "sweeps", "records", "observer", "daemon", "diagnosing-a-gap")
FENCE = re.compile(r"^```(?:sh|\{ \.sh \.run \})\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
LEFT_OUT = {
    "make demo": "tests/house/test_first_hour.py runs the demo",
    "armlink demo": "the same, for an arm file too",
    "armlink sim": "runs all the while",
    "sudo ": "changes the machine",
    "podman ": "builds an image; tests/house/test_container.py checks its files and options",
    "armlink gap diagnose --sim so101.xml": "needs recordings of that arm; tests/sim_gap/position_gap has its own",
    "armlink gap diagnose-fleet": "needs a dask scheduler; tests/sim_gap runs it on one",
}
"""Beginning of a line: why it is not run."""
DAEMON_SECONDS = 180
OLD, NEW = "1f0c9a2b", "77e01d3c"
"""Ids in the documentation: of an earlier calibration record and of the current one."""


def lines_of(page: str) -> list[str]:
    """The simple commands of a page, in order."""
    text = (ROOT / "docs" / f"{page}.md").read_text()
    blocks = "".join(found["text"] for found in FENCE.finditer(text)).replace("\\\n", " ")
    return [line.partition("  #")[0].strip() for line in blocks.splitlines() if line.strip()]


def left_out(line: str) -> str:
    """Why a line is not run; empty where it is."""
    return next((why for begin, why in LEFT_OUT.items() if line.startswith(begin)), "")


class Walk:
    """One newcomer, in one folder."""

    def __init__(self, folder: Path, bus: str, pipe: Path) -> None:
        """With the simulated arm running on `bus`."""
        self.folder, self.bus, self.pipe = folder, bus, pipe
        self.environment = {
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "XDG_STATE_HOME": str(folder / "state-home"),
            "COLUMNS": "160",
        }
        self.wrong: list[str] = []
        self.run = self.skipped = 0

    def page(self, page: str) -> None:
        """All its lines."""
        self._prepare(page)
        for line in lines_of(page):
            why = left_out(line)
            if why:
                self.skipped += 1
                continue
            self.type(page, line)

    def type(self, page: str, line: str) -> None:
        """One line of a page, with this arm."""
        self.run += 1
        self._line(page, self._as_here(line))

    def _prepare(self, page: str) -> None:
        """What the reader has before a page that the pages before it do not make."""
        if page == "sweeps":
            self._shell("rm -r unloaded", 30)  # swept again there, as one's own arm
        elif page == "records":
            self._shell(f"armlink history my-arm.yaml --record {self._ids()[0]} > last-year.yaml", 60)
        if page in ("records", "diagnosing-a-gap"):
            self._recordings(("slow", "other") if page == "records" else ("fast", "run"))

    def _recordings(self, names: tuple[str, ...]) -> None:
        """Recordings of planned motions, as MCAP and CSV."""
        for name in names:
            plan = f"armlink gap plan my-arm.yaml --joint j2 --poses 1 --seed {len(name)} --out {name}-motion.csv"
            collect = f"armlink gap collect my-arm.yaml --motion {name}-motion.csv --out {name}.mcap"
            convert = f"armlink convert {name}.mcap {name}.csv"
            self._line("prepared", plan)
            self._line("prepared", collect)
            self._line("prepared", convert)

    def _ids(self) -> tuple[str, str]:
        """Ids of the oldest calibration record and of the current one."""
        self._shell("armlink history my-arm.yaml --json ids.json", 60)
        records = json.loads((self.folder / "ids.json").read_text())["records"]
        kept = [each for each in records if each["kind"] == "calibration"]
        return kept[0]["id"], next((each["id"] for each in kept if each["current"]), kept[-1]["id"])

    def _as_here(self, line: str) -> str:
        """A line with this arm, this bus and these records."""
        line = re.sub(r"\b(sarcos|arm\.yaml|arm\.xml)(?= |$)", "my-arm.yaml", line).replace("my-my-arm", "my-arm")
        line = re.sub(r"(socketcan:\S+|udp_multicast:\S+)", self.bus, line)
        if OLD in line or NEW in line:
            old, new = self._ids()
            line = line.replace(OLD, old).replace(NEW, new)
        return line

    def _line(self, page: str, line: str) -> None:
        """Run one line, and judge how it ended."""
        begin = time.monotonic()
        mass = re.search(r"--reference-mass (\S+)", line)
        if mass:
            self.pipe.write_text(f"mass {mass[1]}\n")
        if line.startswith("armlink daemon"):
            status, said = self._daemon(line)
        elif line.startswith("curl"):
            status, said = 0, ""  # asked while the daemon ran
        else:
            status, said = self._shell(line, 1200)
        if mass:
            self.pipe.write_text("mass 0\n")
        print(f"{page}: {line}: exit {status}, {time.monotonic() - begin:.0f} s", flush=True)
        if status:
            print("   ", *said.strip().splitlines()[-1:], flush=True)
            self.wrong.append(f"{page}: {line}: exit {status}: {' '.join(said.split())[-300:]}")
        self.wrong += [f"{page}: {line}: {text}" for text in said.splitlines() if any(word in text for word in FALSE)]

    def _shell(self, line: str, seconds: float) -> tuple[int, str]:
        done = subprocess.run(
            ["bash", "-c", f"set -o pipefail; {line}"],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )
        return done.returncode, done.stderr

    def _daemon(self, line: str) -> tuple[int, str]:
        """A daemon until its page answers and it observes, or has heard that nobody sends SYNC."""
        api = self.folder / "state" / "api.sock"
        words = [*shlex.split(line), *(() if "--state" in line else ("--state", "./state"))]
        wanted = "fault" if "--listen-only" in line else "observing"
        with (self.folder / "daemon.log").open("a+") as log:
            process = subprocess.Popen(words, cwd=self.folder, env=self.environment, stderr=log)
            state, end = "", time.monotonic() + DAEMON_SECONDS
            while state != wanted and time.monotonic() < end and process.poll() is None:
                time.sleep(0.5)
                state = _state(api)
            process.send_signal(signal.SIGTERM)
            status = process.wait(30)
        said = (self.folder / "daemon.log").read_text()
        return (status, "") if state == wanted else (status or 1, f"state is {state!r}, expected {wanted}: {said}")


def _state(api: Path) -> str:
    """The daemon's state; empty while nobody answers."""
    connection = HTTPConnection("localhost", timeout=5)
    connection.sock = socket.socket(socket.AF_UNIX)
    try:
        connection.sock.connect(str(api))
        connection.request("GET", "/api/status")
        return str(json.loads(connection.getresponse().read())["state"])
    except OSError:
        return ""
    finally:
        connection.close()


def main() -> int:
    """Walk; tell."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="keep everything here")
    parser.add_argument("--pages", nargs="+", default=PAGES)
    parser.add_argument("--group", type=int, default=os.getpid() % 200 + 10, help="last byte of the multicast group")
    options = parser.parse_args()
    folder = options.out or Path(tempfile.mkdtemp(prefix="docs-walk-"))
    folder.mkdir(parents=True, exist_ok=True)
    bus = f"udp_multicast:239.74.166.{options.group}"
    interface, _, channel = bus.partition(":")
    described = describe(folder, bus={"interface": interface, "channel": channel})
    (folder / "my-arm.yaml").write_text(described.read_text())
    with simulated(folder, bus, SEED) as (pipe, _):
        walk = Walk(folder, bus, pipe)
        for page in options.pages:
            walk.page(page)
    print(json.dumps({"run": walk.run, "left_out": walk.skipped, "wrong": walk.wrong}, indent=1))
    return 1 if walk.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
