"""Campaign: the units of packaging/ under a real systemd: watchdog, restart, limits, what their programs may write.

python tests/campaigns/systemd_units.py

In a user-mode kernel (scripts/with-systemd), some minutes. The guard between arm0 and vcan0 passes a SYNC and nothing
after a hostile frame, is killed and passes again. The daemon listens to a bus without joints; it is stopped (SIGSTOP)
and then given too little memory. Exit status 1 if something is wrong, 0 with one line where it cannot run.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from armlink.arm_file import bundled_arms

ROOT = Path(__file__).parents[2]
INSIDE = Path(__file__).with_name("under_systemd.py")
ARM = "sarcos"
SYNC, QUICK_STOPS, FIFO = [0x80], [0x600 + node for node in range(1, 8)], 1
EXPECTED: dict[str, dict[str, Any]] = {
    "guard": {
        "passed": SYNC,
        "after_a_hostile_frame": QUICK_STOPS,
        "policy": FIFO,
        "memory_max": 64 << 20,
        "writes_etc": False,
        "restarted": True,
        "passed_again": SYNC,
    },
    "daemon": {
        "watchdog_of_the_unit": "10s",
        "user": 990,
        "memory_max": 1 << 30,
        "writes_etc": False,
        "writes_state": True,
        "sees_homes": False,
        "outside_writes_etc": True,
        "real_time": True,
        "restarts_while_it_lives": 0,
        "lives": 3,
        "watchdog": True,
        "out_of_memory": True,
        "stopped": "success",
    },
}


def configured(folder: Path) -> None:
    """/etc/armlink of the arm "bench"."""
    armlink = [sys.executable, "-c", "from armlink.cli import main; main()"]
    policy = [*armlink, "guard", ARM, "--bus", f"armlink_sim:{ARM}", "--out", str(folder / "bench.guard.json")]
    subprocess.run(policy, check=True, capture_output=True)
    (folder / "bench.yaml").write_text(bundled_arms()[ARM].read_text())
    (folder / "bench.env").write_text("ARMLINK_OPTIONS=--listen-only --bus socketcan:vcan0\n")
    (folder / "bench.guard.env").write_text("PROGRAM=arm0\nWIRE=vcan0\n")
    folder.chmod(0o755)


def main() -> int:
    """Run, compare."""
    with tempfile.TemporaryDirectory() as name:
        configured(Path(name))
        command = [ROOT / "scripts" / "with-systemd", name, "/usr/bin/python3", INSIDE]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 125:
        print(f"skipped: {done.stderr.strip().splitlines()[-1]}")
        return 0
    try:
        found = json.loads(done.stdout)
    except ValueError:
        print(f"FAILED: {done.stdout}{done.stderr}")
        return 1
    print(json.dumps(found, indent=1))
    wrong = [
        f"{part}: {key} is {found[part].get(key)}, expected {value}"
        for part, expected in EXPECTED.items()
        for key, value in expected.items()
        if found[part].get(key) != value
    ]
    wrong += ["guard: it runs as root"] * (found["guard"]["user"] == 0)
    for line in wrong:
        print(f"FAILED: {line}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
