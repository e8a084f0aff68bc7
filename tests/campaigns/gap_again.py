"""Campaign: a second diagnosis, with the same recordings, from the model that the first one wrote.

    python tests/campaigns/gap_again.py [--realdata DIR] [--only lwr4] [--cases 10 --seed 1 --effects 5-8]

On recordings of real arms, and with `--cases` on cases of the blind bench. The second has to answer `no_gap`, or to
change no parameter of a cause by more than 5 %: what MJCF cannot hold comes back as it was, and nothing is added to the
rest. Parameters of one unit are compared together: the components of a mass moment. Exit status 1 if one does not.
"""

import argparse
import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from armlink.arm_file import read_yaml
from armlink.errors import BadInput
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Cause, Diagnosis
from sim_gap.attribution.residual_laws import as_effects
from sim_gap.better_model.export import HELD, write_model
from sim_gap.blind.bench import make_cases
from sim_gap.blind.real_recordings import KNOWN, recordings_of

MOST = 0.05
"""Largest change of a parameter, as a share of it."""
LENGTHS = 120.0, 40.0
"""Training and held-out recordings of a case of the bench [s]."""
ANGLES = {"phase", "rest"}
"""Parameters that say where, not how much."""
MOTORS = ("friction.coulomb", "friction.viscous", "actuator.rotor_inertia")
"""What a sensor on the link does not read of a model: it is named again as it was."""
CARRIED = "link.payload"
"""Is in the file if every recording has it, else named again as it was: the file is that of the arm without it."""
Case = tuple[str, Path, list[Recording], list[Recording], list[str]]
Key = tuple[str, str, str]


def sizes(causes: Sequence[Cause]) -> dict[Key, np.ndarray]:
    """Parameters of each effect and joint, those of one unit together."""
    out: dict[Key, list[float]] = defaultdict(list)
    for cause in causes:
        for joint, values in cause.parameters.items():
            for name, value in values.items():
                if name not in ANGLES:
                    out[cause.effect, joint, value.unit].append(value.value)
    return {key: np.array(values) for key, values in out.items()}


def changes(first: Diagnosis, second: Diagnosis) -> dict[Key, float]:
    """Change of each parameter by the second diagnosis, as a share of it; infinite for what the first did not name."""
    before, after = sizes([*first.causes, *first.minor]), sizes(second.causes)
    unread = MOTORS if first.internals.train.layout.motor is None else ()
    out = {}
    for key, values in after.items():
        was = before.get(key)
        held = key[0] in HELD and key[0] not in unread
        size = 0.0 if was is None else float(np.linalg.norm(was))
        left, moved = (float(np.linalg.norm(each)) for each in (values, values - (0.0 if was is None else was)))
        change = min(left, moved) if key[0] == CARRIED else left if held else moved
        out[key] = change / size if size else float("inf")
    return out


def line(name: str, first: Diagnosis, second: Diagnosis) -> tuple[bool, str]:
    """Whether the second agrees, and what it says."""
    moved = changes(first, second)
    good = second.verdict == "no_gap" or all(change <= MOST for change in moved.values())
    named = ", ".join(f"{effect} {joint} {change:.1%}" for (effect, joint, _), change in moved.items())
    return good, f"{name}: {first.verdict}, {second.verdict}: {named or 'none'}"


def twice(case: Case, folder: Path) -> tuple[bool, str]:
    """Both diagnoses of a case; the model goes into a folder."""
    name, sim, train, heldout, labels = case
    first = diagnose(sim, train, heldout, labels=labels)
    if first.unit == "rad":
        return True, f"{name}: {first.verdict}, positions alone"
    written = folder / f"{name}.xml"
    laws = as_effects(first.laws, first.names)
    write_model(first.internals.model, first.internals.estimate, written, laws)
    try:
        second = diagnose(written, train, heldout, labels=labels)
    except BadInput as error:
        return False, f"{name}: {first.verdict}, refused: {error}"
    return line(name, first, second)


def real_cases(folder: Path, only: str) -> Iterator[Case]:
    for case in read_yaml(KNOWN):
        if only in case["case"] and (folder / case["sim"]).is_file():
            yield case["case"], folder / case["sim"], *recordings_of(folder, case)


def bench_cases(folder: Path, seed: int, cases: int, effects: str) -> Iterator[Case]:
    for _ in make_cases(folder, seed, cases, 1, LENGTHS, effects):
        pass
    for path in sorted((folder / "cases").iterdir()):
        train, heldout = ([load_recording(path / f"{each}.csv")] for each in ("train", "heldout"))
        yield path.name, path / "sim.xml", train, heldout, ["train", "heldout"]


def main() -> int:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--realdata", default=os.environ.get("ARMLINK_REALDATA", "../shared/realdata"))
    parser.add_argument("--only", default="", help="cases of real arms whose name has this in it")
    parser.add_argument("--cases", type=int, default=0, help="cases of the blind bench instead")
    parser.add_argument("--effects", default="", help="number of effects in each of them, such as 5-8")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with TemporaryDirectory(prefix="armlink-again-") as scratch:
        made = Path(scratch)
        cases = bench_cases(made, options.seed, options.cases, options.effects) if options.cases else None
        agreed = []
        for case in cases or real_cases(Path(options.realdata), options.only):
            good, text = twice(case, made)
            agreed.append(good)
            print(("" if good else "NOT ") + text, flush=True)
    print(f"{sum(agreed)} of {len(agreed)} agree with themselves")
    return 0 if all(agreed) else 1


if __name__ == "__main__":
    sys.exit(main())
