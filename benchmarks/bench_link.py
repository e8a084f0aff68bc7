"""The cyclic path against canopen, on SocketCAN: this host's vcan0, else a user-mode kernel's."""

import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

from side_by_side import Case

HERE = Path(__file__).parent
RUNS, SECONDS = 7, 1.5
PEER = "canopen RemoteNode, PDO variables"


def cases() -> list[Case]:
    """Cycles per second and CPU per frame; fails with with-vcan's reason if there is no vcan0."""
    return [
        _case("link_cycle_vs_canopen", "cycles/s", "cycles", less_is_better=False),
        _case("link_cpu_per_frame_vs_canopen", "µs", "cpu", less_is_better=True),
    ]


def _case(name: str, unit: str, key: str, less_is_better: bool) -> Case:
    """A case with runs taken in turn by link_cycle.py in one session; the first pair is the warm-up."""
    ours, peer = (iter([run[side][key] for run in _session()]) for side in ("ours", "peer"))
    return Case(name, unit, lambda: next(ours), lambda: next(peer), PEER, less_is_better, RUNS)


@cache
def _session() -> list[dict[str, Any]]:
    command = [HERE.parent / "scripts" / "with-vcan", sys.executable, HERE / "link_cycle.py", "vcan0"]
    done = subprocess.run([*command, str(RUNS + 1), str(SECONDS)], stdout=subprocess.PIPE, check=True)
    result: list[dict[str, Any]] = json.loads(done.stdout)
    return result
