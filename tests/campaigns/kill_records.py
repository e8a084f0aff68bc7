"""Campaign: SIGKILL at random moments of record writes, activations and writes to controllers.

python tests/campaigns/kill_records.py [--kills 200] [--seed 0] [--postgresql | --url postgresql://…]
Exit status 1 if a record is torn or lost, the store does not open, or controllers and current record disagree.

A child process keeps records, makes them current and writes them to two controllers whose memory is a file, object by
object as 2100h is written, and notes after each step what it was told is done. The parent kills it at a random moment
and looks: each record that was acknowledged is there and whole, no other has half a body, the current one is
no older than the last that was acknowledged, and after `recover` the controllers hold the pair of the current record.
"""

import argparse
import json
import os
import random
import signal
import sqlite3
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "calib"))
from fake_controllers import ARM, NAMES
from postgres import server

from armlink.errors import BadInput
from armlink.link.types import Calibration, DriveSerial
from armlink.torque_calibration import UNCALIBRATED
from calib.install.journaled_write import install, recover
from calib.install.plausibility import admit_rollback
from calib.records.records import CalibrationRecord, JointCalibration, provenance
from calib.records.store import RecordStore

LONGEST = 0.4
"""The child is killed after at most this long [s]: some twenty records."""


EMPTY = {"gain": 1.0, "offset": 0.0, "record_id": 0, "date": 0}


def numbered(number: int) -> CalibrationRecord:
    """The number-th record: a gain and an offset of its own."""
    joints = tuple(
        JointCalibration(
            name=name, gain=1.0 + number * 1e-4, offset=number * 1e-3 + k, position_gain=1.0, position_offset=0.0
        )
        for k, name in enumerate(NAMES)
    )
    return CalibrationRecord(
        **provenance(ARM, created=datetime(2026, 11, 21, tzinfo=UTC)), joints=joints, note=str(number)
    )


class Memory:
    """Two controllers whose objects are a file, each written one after the other as 2100h is."""

    def __init__(self, path: Path) -> None:
        """With new controllers where the file is missing."""
        self._path = path
        if not path.exists():
            self._save([{"active": dict(EMPTY), "staged": dict(EMPTY)} for _ in NAMES])

    def drive_serial(self, joint: int) -> DriveSerial:
        """Of the drive."""
        return DriveSerial(f"1:1:{joint}")

    def read_calibration(self, joint: int) -> Calibration:
        """The active pair."""
        active = self._load()[joint]["active"]
        return Calibration(active["gain"], active["offset"], int(active["record_id"]), int(active["date"]))

    def write_calibration(self, joint: int, calibration: Calibration, store: bool = False) -> Calibration:
        """Stage object after object, then activate: a kill may come between any two."""
        for key in ("gain", "offset", "record_id", "date"):
            held = self._load()
            held[joint]["staged"][key] = getattr(calibration, key)
            self._save(held)
        held = self._load()
        held[joint]["active"] = dict(held[joint]["staged"])
        self._save(held)
        return self.read_calibration(joint)

    def _load(self) -> list[dict[str, dict[str, float]]]:
        return json.loads(self._path.read_text())

    def _save(self, held: Sequence[dict[str, dict[str, float]]]) -> None:
        part = self._path.with_suffix(".part")
        part.write_text(json.dumps(held))
        part.replace(self._path)


def work(url: str, folder: Path, first: int) -> None:
    """What the child does until it is killed: keep, make current, write; `done` has a line for each answer."""
    store, memory = RecordStore(url), Memory(folder / "controllers.json")
    with (folder / "done").open("a") as done:
        for number in range(first, first + 1000):
            if number % 3 == 0:
                held = {j: memory.read_calibration(j) for j in range(len(NAMES))}
                admitted = admit_rollback(numbered(number), ARM, store, held)
                install(admitted, store, memory, by="child", reason="write", check=None)
                done.write(f"installed {number}\n")
            else:
                store.add(numbered(number))
                done.write(f"added {number}\n")
            done.flush()


def look(url: str, folder: Path) -> list[str]:
    """What is wrong after a kill; empty where nothing is."""
    wrong: list[str] = []
    answered = [line.split() for line in (folder / "done").read_text().splitlines() if line.count(" ") == 1]
    try:
        store = RecordStore(url)
        kept = {record.note: record for record in store.history(ARM)}
    except BadInput as error:
        return [f"store does not open: {error}"]
    wrong += [f"record {n} was acknowledged and is lost" for _, n in answered if n not in kept]
    wrong += [f"record {n} is torn" for n, record in kept.items() if record != numbered(int(n))]
    memory = Memory(folder / "controllers.json")
    recover(ARM, store, memory)
    current = store.current(CalibrationRecord, ARM)
    installed = [int(n) for what, n in answered if what == "installed"]
    if installed and (current is None or int(current.note) < max(installed)):
        wrong.append(f"{max(installed)} was acknowledged as current, now it is {current.note if current else None}")
    for j, name in enumerate(NAMES):
        held = memory.read_calibration(j)
        pair = UNCALIBRATED if current is None else current.joints[j].torque_calibration()
        if not pair.matches(held):
            wrong.append(f"{name} holds {held.gain}, {held.offset}, the current record has {pair}")
    if store.unfinished_write(ARM) is not None:
        wrong.append("a write is still open after mending")
    store.close()
    if url.startswith("/"):
        with sqlite3.connect(url) as connection:
            verdict = connection.execute("PRAGMA integrity_check").fetchone()[0]
        if verdict != "ok":
            wrong.append(f"integrity check: {verdict}")
    return wrong


def campaign(url: str, folder: Path, kills: int, seed: int) -> tuple[int, int, list[str]]:
    """(Records kept, writes cut off, what went wrong) over so many kills of a child on one store."""
    generator, first, cut = random.Random(seed), 0, 0
    (folder / "done").touch()
    RecordStore(url).close()
    for number in range(kills):
        child = os.fork()
        if child == 0:
            work(url, folder, first)
            os._exit(0)
        time.sleep(generator.uniform(0.0, LONGEST))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        store = RecordStore(url)
        cut += store.unfinished_write(ARM) is not None
        store.close()
        wrong = look(url, folder)
        if wrong:
            return 0, cut, [f"kill {number}: {each}" for each in wrong]
        store = RecordStore(url)
        first = max((int(record.note) + 1 for record in store.history(ARM)), default=0)
        store.close()
    return first, cut, []


def main() -> int:
    """Run the campaign and say how it went."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--url", help="database to write to; default: SQLite in a temporary folder")
    parser.add_argument("--postgresql", action="store_true", help="write to a temporary PostgreSQL server instead")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="armlink-kills-") as name, ExitStack() as stack:
        folder = Path(name)
        url = given.url or str(folder / "records.db")
        if given.postgresql:
            url = f"{stack.enter_context(server())}/postgres"
        records, cut, wrong = campaign(url, folder, given.kills, given.seed)
    for line in wrong:
        print(line)
    print(
        f"{given.kills} kills, {records} records written, {cut} writes to controllers cut off and put back: "
        f"{'FAILED' if wrong else 'no record torn or lost'}"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
