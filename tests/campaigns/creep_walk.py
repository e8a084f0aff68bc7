"""Campaign: docs/no-torque-sensors.md typed in order, between two processes and in real time, on the simulated OpenArm.

    python tests/campaigns/creep_walk.py [--out DIR] [--group 7]

The procedure of `armlink demo --arm openarm` in real time, command by command, over udp_multicast. About half an hour.
Prints a line a command, and leaves `summary.json` in DIR beside the data sets; exit status 1 where a command does not
end as the page says.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "calib"))
from docs_walk import Walk, left_out, lines_of
from small_pair import on_bus

PAGE = "no-torque-sensors"


class CreepWalk(Walk):
    """With the OpenArm in the place of the short arm."""

    def _as_here(self, line: str) -> str:
        line = super()._as_here(line)
        return f"{line} --yes" if line.startswith("armlink check") else line


def main() -> int:
    """Walk; tell."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="keep everything here")
    parser.add_argument("--group", type=int, default=os.getpid() % 200 + 10, help="last byte of the multicast group")
    options = parser.parse_args()
    folder = options.out or Path(tempfile.mkdtemp(prefix="creep-walk-"))
    folder.mkdir(parents=True, exist_ok=True)
    bus = f"udp_multicast:239.74.167.{options.group}"
    with on_bus(folder, "openarm", bus, 1) as (pipe, _):
        walk = CreepWalk(folder, bus, pipe)
        for line in lines_of(PAGE):
            if left_out(line):
                walk.skipped += 1
            else:
                walk.type(PAGE, line)
    summary = json.dumps({"run": walk.run, "left_out": walk.skipped, "wrong": walk.wrong}, indent=1)
    (folder / "summary.json").write_text(summary, encoding="utf-8")
    print(summary)
    print(f"data sets and summary: {folder}")
    return 1 if walk.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
