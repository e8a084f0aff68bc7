"""Five models, each from the model to a finished demo report by the three commands of docs/first-hour.md.

python tests/campaigns/first_hour.py [--models FOLDER] [--only NAME …]

Panda and OpenArm come from PyPI (example-robot-data, openarm-mujoco) into FOLDER, by default a temporary one.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

OURS = Path(__file__).parents[1] / "models"
PACKAGES = ("example-robot-data", "openarm-mujoco")
MODELS = {
    "arm4": OURS / "arm4.urdf",
    "ur10e": OURS / "ur10e.urdf",
    "own": OURS / "own.xml",
    "panda": "**/panda_description/urdf/panda.urdf",
    "openarm": "**/openarm_bimanual.xml",
}


def main() -> int:
    """Type the commands for every model; exit status 1 where one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--only", nargs="*", default=sorted(MODELS))
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="first-hour-"))
    models = options.models or folder / "models"
    if {"panda", "openarm"} & set(options.only) and not list(models.glob(str(MODELS["panda"]))):
        install = ["install", "--quiet", "--no-deps", "--target", str(models), *PACKAGES]
        subprocess.run([sys.executable, "-m", "pip", *install], check=True)
    return max([first_hour(name, models, folder) for name in options.only])


def first_hour(name: str, models: Path, folder: Path) -> int:
    """One model; 0 if all went well."""
    found = MODELS[name]
    model = found if isinstance(found, Path) else next(models.glob(found))
    arm, out, began = folder / f"{name}.yaml", folder / name, time.monotonic()
    for words in (
        ["new", str(model), "--out", str(arm)],
        ["doctor", str(arm)],
        ["demo", "--arm", str(arm), "--out", str(out)],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "armlink.cli", *words],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            print(f"{name}: armlink {words[0]}: exit status {done.returncode}: {done.stderr[-600:]}")
            return 1
    summary = json.loads((out / "summary.json").read_text())
    if not (out / "report.html").is_file():
        print(f"{name}: no report")
        return 1
    print(
        f"{name}: {len(summary['joints'])} joints, report after {time.monotonic() - began:.0f} s in {out}", flush=True
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
