"""Draw a round of cases, let every tool answer, open the labels, score: `make referee`, docs/appendix/referee.md."""

import argparse
import math
import shutil
import sys
from datetime import UTC, datetime
from pathlib import Path

from referee import page
from referee.rounds import play, pooled


def main() -> int:
    """Play the rounds that are asked for, and write the tables."""
    parser = argparse.ArgumentParser(prog="make referee", description=__doc__)
    today = int(datetime.now(UTC).strftime("%Y%m%d"))
    parser.add_argument("--cases", type=int, default=66, help="cases of a round")
    parser.add_argument("--seed", type=int, nargs="+", default=[today], help="a round each; by default that of the day")
    parser.add_argument("--only", nargs="+", default=[], help="names of the tools that take part")
    parser.add_argument("--adapter", type=Path, nargs="+", default=[], help="further adapters")
    parser.add_argument("--cpu-seconds", type=float, default=60.0, help="processor time of a tool for a case")
    more = "no answer of a round is begun after so many minutes; cases that some tool lacks do not count"
    parser.add_argument("--minutes", type=float, default=math.inf, help=more)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("referee-out"))
    parser.add_argument("--models", type=Path, help="folder with example-robot-data: published arms take part")
    parser.add_argument("--real", type=Path, help="folder of labelled real recordings (sim_gap/blind/real_arms.yaml)")
    parser.add_argument("--page", type=Path, help="page whose table is written anew")
    options = parser.parse_args()
    for seed in options.seed:
        shutil.rmtree(options.out / str(seed), ignore_errors=True)
    rounds = [play(options, seed) for seed in options.seed]
    rounds = [pooled(rounds), *rounds] if len(rounds) > 1 else rounds
    (options.out / "table.md").write_text(page.markdown(rounds), encoding="utf-8")
    (options.out / "referee.svg").write_text(page.svg(rounds[0]), encoding="utf-8")
    if options.page:
        page.write_page(options.page, rounds)
    print(page.markdown(rounds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
