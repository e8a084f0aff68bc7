"""Published arm models, each put through `new`, `doctor` and `demo` as a newcomer would, and judged.

`published_models.py FOLDER… [--out table.md] [--only NAME…] [--seconds 300] [--seed 1]`: every URDF and MJCF below the
folders that has an arm in it. Each must either be refused by `new` or `doctor` in one line, before anything moves, or
reach its report with exit status 0 and with errors inside their intervals. Writes a table in Markdown, in place of the
one that ends the page `--out`; exit status 1 where a model did neither.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binom

ARMLINK = str(Path(sys.executable).with_name("armlink"))
CHANCE = 1e-3
"""So many of a model's intervals of 95 % may fail as chance makes no more often than this."""


@dataclass
class Outcome:
    """What became of one model."""

    name: str
    joints: int = 0
    new: str = ""
    doctor: str = ""
    demo: str = ""
    seconds: float = 0.0
    gain_error: float = float("nan")
    """Largest error of an identified torque gain, as a share."""
    inside: int = 0
    """How many of the 95 % intervals of gains and offsets hold, and how many there are."""
    intervals: int = 0
    gravity_error: float = float("nan")
    """Largest RMS error of a joint's gravity torque, as a share of the largest torque of any."""

    @property
    def good(self) -> bool:
        """Whether it was refused in time, or reached a sound report."""
        if self.new.startswith("refused") or self.doctor.startswith("refused"):
            return True
        return self.demo == "report" and bool(binom.cdf(self.inside, self.intervals, 0.95) > CHANCE)

    def row(self) -> str:
        """A line of the table."""
        if self.demo != "report":
            said = next(text for text in (self.demo, self.doctor, self.new) if text)
            return f"| {self.name} | {self.joints or ''} | {said} | {self.seconds:.0f} | | | |"
        return (
            f"| {self.name} | {self.joints} | report | {self.seconds:.0f} | {100 * self.gain_error:.2f} % | "
            f"{self.inside} of {self.intervals} | {100 * self.gravity_error:.2f} % |"
        )


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """The error of a command, without its program's name; "traceback" where it is none."""
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    if "Traceback" in done.stderr or not lines:
        return f"exit {done.returncode} with a traceback"
    return lines[-1].removeprefix("armlink: ")


def processor_seconds() -> float:
    """Of all commands so far: what else the machine does counts little."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def command(*words: str, seconds: float) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run([ARMLINK, *words], capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired as late:
        return subprocess.CompletedProcess(words, 124, "", f"not done after {late.timeout:.0f} s")


def judge(model: Path, seed: int, seconds: float) -> Outcome:
    found = Outcome(f"{model.parent.name}/{model.name}")
    with tempfile.TemporaryDirectory() as folder:
        arm, out = Path(folder) / "arm.yaml", Path(folder) / "demo"
        begin = processor_seconds()
        new = command("new", str(model), "--out", str(arm), seconds=seconds)
        if new.returncode == 2:
            found.new = f"refused: {one_line(new)}".replace(str(model), model.name).replace(str(arm), "the arm file")
            found.seconds = processor_seconds() - begin
            return found
        if new.returncode != 0:
            found.new = f"failed: {one_line(new)}"
            return found
        doctor = command("doctor", str(arm), "--offline", "--json", "-", seconds=seconds)
        answer = json.loads(doctor.stdout)
        errors = [each for each in answer["findings"] if each["level"] == "error"]
        if errors:
            found.doctor = f"refused: {errors[0]['where']}: {errors[0]['what']}: {errors[0]['remedy']}"
        demo = command("demo", "--arm", str(arm), "--seed", str(seed), "--out", str(out), seconds=seconds)
        found.seconds = processor_seconds() - begin
        if demo.returncode != 0:
            found.demo = f"failed: {one_line(demo)}"
            if errors and demo.returncode == 2:
                found.demo = ""
            return found
        take(found, json.loads((out / "summary.json").read_text()))
    return found


def take(found: Outcome, summary: dict) -> None:
    """The figures of a demo's summary."""
    found.demo, found.joints = "report", len(summary["joints"])
    inside: list[bool] = []
    for key, sensor in summary["sensors"].items():
        for true, estimated, interval in zip(sensor["true"], sensor["estimated"], sensor["ci95"], strict=True):
            if estimated is None or interval is None or None in interval:
                continue
            inside.append(interval[0] <= true <= interval[1])
            if key == "gain":
                found.gain_error = float(np.fmax(found.gain_error, abs(estimated / true - 1)))
    found.inside, found.intervals = sum(inside), len(inside)
    rms, most = summary["gravity"]["rms_error"], max(summary["gravity"]["max_torque"])
    found.gravity_error = max(rms) / most if most else float("nan")


def models(folders: list[Path]) -> list[Path]:
    """URDF and MJCF files that hold a robot."""
    found = []
    for folder in folders:
        each = [folder] if folder.is_file() else sorted([*folder.rglob("*.urdf"), *folder.rglob("*.xml")])
        found += [path for path in each if b"<robot" in (text := path.read_bytes()[:20_000]) or b"<mujoco" in text]
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    outcomes = []
    for model in models(given.folders):
        if given.only and not any(name in str(model) for name in given.only):
            continue
        outcomes.append(judge(model, given.seed, given.seconds))
        print(("good " if outcomes[-1].good else "WRONG ") + outcomes[-1].row(), flush=True)
    heading = (
        "| model | joints | outcome | CPU time [s] | gain error | intervals | gravity error |\n"
        "|---|---|---|---|---|---|---|"
    )
    table = "\n".join([heading, *(each.row() for each in outcomes)])
    held, told = (sum(getattr(each, of) for each in outcomes) for of in ("inside", "intervals"))
    print(f"{sum(each.good for each in outcomes)} of {len(outcomes)} models good; {held} of {told} intervals hold")
    if given.out is not None:
        page = given.out.read_text(encoding="utf-8") if given.out.exists() else ""
        given.out.write_text(page.partition("| model |")[0] + table + "\n", encoding="utf-8")
    return int(not all(each.good for each in outcomes))


if __name__ == "__main__":
    sys.exit(main())
