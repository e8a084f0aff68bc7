"""Campaign: a bus of each drive family, found and written to an arm file as its owner would, in real time.

    python tests/campaigns/discovery.py [--only six-damiao …] [--bus udp_multicast:239.74.163.84] [--seed 1]

The ids of a bundled arm are drawn anew; one drive has no power and, where a family has reply ids, one answers on the
value as delivered. `armlink scan` and `new` must name both. With both put right, `armlink new ARM --bus BUS --by-hand`
asks on a terminal, the joints of the simulated arm are turned as it asks, and the file that it writes must give each
joint its drive, and pass `armlink check` and a short `armlink sweep`.

Prints a line for each arm. Exit status 1 if one of these does not hold.
"""

import argparse
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path

import numpy as np
import yaml

from armlink.arm_file import bundled_arms

ARMLINK = str(Path(sys.executable).with_name("armlink"))
FAMILIES = ("cia402", "damiao", "robstride", "moteus", "odrive", "myactuator", "piper")
"""CubeMars drives are only heard beside their host: what would ask them commands them."""
ABSENT, AS_DELIVERED = 2, 3
"""Joints of the drive without power and of the one whose reply id is 0."""
SHORT = {"motion": "steps", "steps": 5, "poses": 1, "loaded_poses": 1, "hold": "servo", "standard_error": 0.005}
"""A sweep that takes a minute: what is asked here is whether it runs."""
ASKED = re.compile(
    r"(\S+): (?:now )?turn (?:this joint by hand|it) to its (?:lower|upper)\s+stop\s+\(([-+]\d+\.\d+)\s+rad\)"
)
LOWEST = 25.0
"""Rate that is tried at least [Hz]: the kernel of `scripts/with-vcan` has one emulated processor for arm and host."""
STARTED, ENDED = 20.0, 900.0
"""Seconds within which the simulated arm stands on the bus and a command ends."""


def identity(drive: dict) -> str:
    return next(key for key in ("node", "id", "joint") if key in drive)


def kept_rate(arm: str) -> float:
    """Rate of a bundled arm, or the lower one that this machine keeps with the simulated arm beside it [Hz]."""
    asked = [ARMLINK, "check", arm, "--host", "--seconds", "2", "--json", "-"]
    answer = subprocess.run(asked, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    rate = yaml.safe_load(bundled_arms()[arm].read_text())["link"]["rate"]
    return min(rate, max(LOWEST, round(json.loads(answer.stdout)["holds_hz"] / 2)))


def described(arm: str) -> dict:
    """The content of a bundled arm's file at a rate that this machine keeps."""
    content = yaml.safe_load(bundled_arms()[arm].read_text()) | {"sweep": SHORT}
    content["link"]["rate"] = kept_rate(arm)
    return content


def shuffled(content: dict, seed: int) -> dict:
    """An arm file's content with the drives' ids drawn anew."""
    content = deepcopy(content)
    drives = [joint["drive"] for joint in content["link"]["joints"]]
    key = identity(drives[0])
    if key != "joint":  # Piper's joints have no ids
        others = np.random.default_rng(seed).permutation([drive[key] for drive in drives])
        for drive, other in zip(drives, others.tolist(), strict=True):
            drive[key] = other
    return content


@contextmanager
def served(content: dict, folder: Path, bus: str, *faults: str) -> Iterator[Path]:
    """`armlink sim` of an arm file on the bus; its pipe."""
    path, control = folder / "there.yaml", folder / "arm.pipe"
    path.write_text(yaml.safe_dump(content))
    words = [ARMLINK, "sim", str(path), "--bus", bus, "--control", str(control)]
    for fault in faults:
        words += ["--fault", fault]
    told = folder / "sim.log"
    with told.open("w") as log, subprocess.Popen(words, stderr=log) as sim:
        try:
            end = time.monotonic() + STARTED
            while "stop with Ctrl-C" not in told.read_text():
                if time.monotonic() > end or sim.poll() is not None:
                    raise RuntimeError(f"the arm does not start: {told.read_text()}")
                time.sleep(0.1)
            yield control
        finally:
            sim.terminate()


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    words, quiet = (ARMLINK, *words), subprocess.DEVNULL
    return subprocess.run(words, cwd=folder, stdin=quiet, capture_output=True, text=True, timeout=ENDED, check=False)


def turned_by_hand(folder: Path, control: Path, *words: str) -> tuple[int, str]:
    """Exit status and output of a command on a terminal of 80 columns, of which each request is followed."""
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(folder)
        os.environ.update(COLUMNS="80", LINES="50")
        os.execv(ARMLINK, [ARMLINK, *words])
    shown, done, end = "", 0, time.monotonic() + ENDED
    while time.monotonic() < end:
        if not select.select([terminal], [], [], 1.0)[0]:
            continue
        try:
            shown += os.read(terminal, 65536).decode(errors="replace")
        except OSError:  # the command has ended
            break
        plain = " ".join(re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown).split())
        requests = ASKED.findall(plain)
        if len(requests) > done and plain.endswith("then press Enter:"):
            done = len(requests)
            control.write_text("hand {}:{}\n".format(*requests[-1]))
            time.sleep(0.5)
            os.write(terminal, b"\n")
        elif plain.endswith(("[y/n]:", "[Y/n]:", "[y/N]:")):
            os.write(terminal, b"y\n")
    else:
        os.kill(process, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), shown


def tried(arm: str, bus: str, seed: int) -> list[str]:
    """What did not hold for an arm."""
    wrong, own = list[str](), described(arm)
    content = shuffled(own, seed)
    joints = content["link"]["joints"]
    drives, kind = {joint["name"]: joint["drive"] for joint in joints}, joints[0]["drive"].get("family", "canopen")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        bundled = folder / "arm.yaml"
        bundled.write_text(yaml.safe_dump(own))
        first = deepcopy(content)
        delivered = first["link"]["joints"][AS_DELIVERED]["drive"]
        if "reply" in delivered:
            delivered["reply"] = 0
        silent = [f"node.silent:{joints[ABSENT]['name']}"] if identity(delivered) != "joint" else []
        with served(first, folder, bus, *silent):  # a Piper's joints share one controller
            scan = command(folder, "scan", "--bus", bus, "--json", "-")
            found = json.loads(scan.stdout or '{"nodes": []}')["nodes"]
            if len(found) != len(joints) - len(silent):
                wrong.append(f"scan found {len(found)} drives: {scan.stderr[-200:]}")
            if "reply" in delivered and not any("as delivered" in (each.get("wrong") or "") for each in found):
                wrong.append("scan does not name the reply id as delivered")
            new = command(folder, "new", str(bundled), "--bus", bus, "--out", "few.yaml")
            if silent and (new.returncode == 0 or "answer" not in new.stderr):
                wrong.append(f"new with a drive too few: exit {new.returncode}, {new.stderr[-200:]}")
        with served(content, folder, bus) as control:
            control.write_text("effect friction.coulomb::40\n")  # somebody holds the arm: no joint falls
            status, shown = turned_by_hand(
                folder, control, "new", str(bundled), "--bus", bus, "--by-hand", "--out", "found.yaml"
            )
            rest = zip(drives, content["sim"]["start"], strict=True)  # the arm is laid down and let go
            control.write_text("".join(f"hand {joint}:{angle}\n" for joint, angle in rest) + "effects none\n")
            time.sleep(1.0)
            if status != 0:
                return [*wrong, f"new: exit {status}, {shown[-400:]}"]
            written = yaml.safe_load((folder / "found.yaml").read_text())["link"]["joints"]
            for joint in written:
                there, drive = drives[joint["name"]], joint["drive"]
                key = identity(there)
                if drive[key] != there[key] or drive.get("family", "canopen") != kind:
                    wrong.append(f"{joint['name']}: {drive}, there is {there}")
            for words in ("check found.yaml", "sweep found.yaml --out d --keep-going 5"):
                done = command(folder, *words.split(), "--bus", bus, "--yes")
                if done.returncode != 0:
                    late = (folder / "sim.log").read_text().count("ms late")
                    said = f"exit {done.returncode} (the simulated arm was late {late} times)"
                    wrong.append(f"{words}: {said}, {(done.stdout + done.stderr)[-600:]}")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[f"six-{each}" for each in FAMILIES])
    parser.add_argument("--bus", default="udp_multicast:239.74.163.84")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    failed = 0
    for arm in given.only:
        began, wrong = time.monotonic(), tried(arm, given.bus, given.seed)
        failed += bool(wrong)
        print(f"{arm}: {'; '.join(wrong) or 'found, checked, swept'} ({time.monotonic() - began:.0f} s)", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
