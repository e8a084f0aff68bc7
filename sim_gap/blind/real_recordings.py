"""The bench of real arms: recordings of a folder, diagnosed and sealed before what is known of the arms is read.

What is known stands in `real_arms.yaml`: effects that an arm has (`has`),
of which one has to come first, those that have to be named, and those that nobody knows (`open`), which do not count.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from armlink.arm_file import read_yaml
from armlink.errors import BadInput
from armlink.recording.files import load_recording
from armlink.recording.recording import Recording, slice_rows
from sim_gap.attribution.diagnose import diagnose
from sim_gap.blind.bench import Json, Progress, refuse_earlier, seal_answers, verify
from sim_gap.blind.score import CONFIDENT, WITHHELD, answer_name, share

SCHEMA = "armlink.real-bench/1"
KNOWN = Path(__file__).with_name("real_arms.yaml")
RIGHT_FIRST, FALSE = 0.85, 0.05
"""Required shares: right first, and cases with a false cause above 0.8."""


def run_real(
    folder: Path, out: Path, known: Path = KNOWN, progress: Progress = lambda *_: None, workers: int = 1
) -> Json:
    """Diagnose the recordings of `folder`, seal the answers under `out`, then score them.

    Sets whose files are missing are left out and listed. Raises BadInput if none is there, or `out` holds an earlier
    bench.
    """
    refuse_earlier(out)
    cases: list[Json] = read_yaml(known)
    missing = [case["case"] for case in cases if not all((folder / name).is_file() for name in _files(case))]
    here = [case for case in cases if case["case"] not in missing]
    if not here:
        raise BadInput(f"{folder} holds none of the recordings of {known}: expected for example {_files(cases[0])[0]}")
    tasks = [(case, effect) for case in here for effect in ("", *case.get("withhold", ()))]
    jobs = {answer_name(case["case"], effect): partial(diagnose_real, folder, case, effect) for case, effect in tasks}
    digest = seal_answers(out / "answers", jobs, workers, progress)
    return {**score_real(verify(out / "answers", digest), here), "sealed": digest, "missing": missing}


def _files(case: Json) -> list[str]:
    return [case["sim"], *case["train"], *case.get("heldout", ())]


def diagnose_real(folder: Path, case: Json, withheld: str) -> Json:
    train, heldout, labels = recordings_of(folder, case)
    less = [withheld] if withheld else []
    return diagnose(folder / case["sim"], train, heldout, labels=labels, withhold=less).to_json()


def recordings_of(folder: Path, case: Json) -> tuple[list[Recording], list[Recording], list[str]]:
    train, heldout = ([load_recording(folder / name) for name in case.get(key, ())] for key in ("train", "heldout"))
    if "share" in case:
        cuts = [int(case["share"] * len(each.t)) for each in train]
        heldout = [slice_rows(each, slice(cut, None)) for each, cut in zip(train, cuts, strict=True)]
        train = [slice_rows(each, slice(0, cut)) for each, cut in zip(train, cuts, strict=True)]
    names = [*case["train"], *(case["heldout"] if "heldout" in case else case["train"])]
    return train, heldout, [Path(name).name.split(".")[0] for name in names]


def score_real(answers: Mapping[str, Mapping[str, Any]], cases: Sequence[Json]) -> Json:
    """Score answers (by name) against what is known of the arms; shares over no case are None. Pure."""
    known = {case["case"]: case for case in cases}
    named = ((*name.partition(WITHHELD)[::2], answer) for name, answer in answers.items())
    rows = [judge_real(answer, known[case], withheld) for case, withheld, answer in named]
    whole = [row for row in rows if not row["withheld"] and row["first_right"] is not None]
    judged = [row for row in rows if row["verdict"] != "refused"]
    shares = {
        "right_first": share([row["first_right"] for row in whole]),
        "named": share([not row["lacking"] for row in whole]),
        "false_confident": share([bool(row["false"]) for row in judged]),
        "refused_as_known": share([row["verdict"] == "refused" for row in rows if row["first_right"] is None]),
    }
    met = (shares["right_first"] or 0.0) >= RIGHT_FIRST and (shares["false_confident"] or 0.0) <= FALSE
    return {"schema": SCHEMA, **shares, "meets": met, "cases": rows}


def judge_real(answer: Mapping[str, Any], case: Json, withheld: str = "") -> Json:
    """One answer against what is known of the arm: the first cause, false ones above 0.8, and what is lacking."""
    causes = answer["causes"]
    fine = {*case.get("has", ()), *case.get("open", ())} - {withheld}
    first = causes[0] if causes else None
    must = {} if withheld else case.get("must", {})
    return {
        "case": case["case"],
        "withheld": withheld or None,
        "verdict": "refused" if "refused" in answer else answer["verdict"],
        "first": first["effect"] if first else None,
        "confidence": first["confidence"] if first else None,
        "first_right": None if case.get("refused") else bool(first and first["effect"] in case["first"]),
        "false": [c["effect"] for c in causes if c["confidence"] > CONFIDENT and c["effect"] not in fine],
        "lacking": [effect for effect, bounds in must.items() if not _named(causes, effect, bounds)],
    }


def _named(causes: Sequence[Mapping[str, Any]], effect: str, bounds: Mapping[str, Sequence[float]]) -> bool:
    """Whether an effect is among the causes, with parameters within these bounds at some joint."""
    values = next((list(cause["parameters"].values()) for cause in causes if cause["effect"] == effect), None)
    return values is not None and all(
        any(low <= v[name]["value"] <= high for v in values) for name, (low, high) in bounds.items()
    )
