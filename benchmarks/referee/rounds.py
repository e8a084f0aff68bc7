"""One round: cases drawn and sealed, answers of every tool, labels opened, scores."""

import argparse
import hashlib
import json
import secrets
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from referee import contest, draw, real, score, seal
from referee.interface import answer_from_json
from referee.measure import errors

MARGIN = 0.05
"""By how much a tool may be above the best other one to count as no worse."""
Json = dict[str, Any]


def play(options: argparse.Namespace, seed: int) -> Json:
    """One round under `out/SEED`."""
    out, key = options.out / str(seed), secrets.token_bytes(32)
    for name in ("cases", "sealed", "answers", "opened"):
        (out / name).mkdir(parents=True)
    hashes = _drawn(options, seed, out, key)
    if options.real:
        hashes |= real.draw_real(options.real, out, key, options.cpu_seconds)
    sealed = json.dumps(hashes, sort_keys=True)
    (out / "sealed" / "hashes.json").write_text(sealed, encoding="utf-8")
    _answer(contest.tools(options.adapter, options.only), out, hashes, options)
    for case, digest in hashes.items():
        opened = json.dumps(seal.opened(out / "sealed", case, key, digest))
        (out / "opened" / f"{case}.json").write_text(opened, encoding="utf-8")
    return scored(out, seed, options)


def scored(out: Path, seed: int, options: argparse.Namespace) -> Json:
    """The result of a round whose answers and opened labels are on disk, over the cases that every tool had."""
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in sorted((out / "answers").glob("*.json"))]
    tools = [tool.name for tool in contest.tools(options.adapter, options.only)]
    count = {case: sum(row["case"] == case for row in rows) for case in {row["case"] for row in rows}}
    rows = [row for row in rows if row["tool"] in tools and count[row["case"]] == len(tools)]
    opened = {
        row["case"]: json.loads((out / "opened" / f"{row['case']}.json").read_text(encoding="utf-8")) for row in rows
    }
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(score_row, row, opened[row["case"]], _sim(out, row["case"])) for row in rows]
        rows = sorted((job.result() for job in jobs), key=lambda row: (tools.index(row["tool"]), row["case"]))
    score.complete(rows)
    digest = hashlib.sha256((out / "sealed" / "hashes.json").read_bytes()).hexdigest()
    made = _result([seed], [digest], options.cpu_seconds, rows)
    (out / "result.json").write_text(json.dumps(made, indent=1), encoding="utf-8")
    return made


def _result(seeds: list[int], digests: list[str], cpu_seconds: float, rows: list[Json]) -> Json:
    return {
        "schema": "armlink.referee/1",
        "seeds": seeds,
        "date": datetime.now(UTC).date().isoformat(),
        "cases": len({row["case"] for row in rows}),
        "cpu_seconds": cpu_seconds,
        "sealed": digests,
        "summary": score.summary(rows),
        "no_worse": {name: score.no_worse(rows, "armlink", name, MARGIN) for name in ("residual", "rollout")},
        "rows": rows,
    }


def pooled(made: list[Json]) -> Json:
    """Several rounds as one."""
    rows = [{**row, "case": f"{each['seeds'][0]} {row['case']}"} for each in made for row in each["rows"]]
    seeds, digests = ([value for each in made for value in each[key]] for key in ("seeds", "sealed"))
    return _result(seeds, digests, made[0]["cpu_seconds"], rows)


def _drawn(options: argparse.Namespace, seed: int, out: Path, key: bytes) -> dict[str, str]:
    """Names of the cases and hashes of their sealed parts."""
    kinds = draw.strata(seed, options.cases)
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        more = (out, key, options.cpu_seconds, options.models)
        jobs = [pool.submit(draw.draw_case, seed, k, kind, *more) for k, kind in enumerate(kinds)]
        for done, job in enumerate(as_completed(jobs), start=1):
            print(f"seed {seed}: {job.result()[0]} drawn, {done} of {len(jobs)}", file=sys.stderr, flush=True)
        return dict(sorted(job.result() for job in jobs))


def _answer(tools: list[contest.Tool], out: Path, hashes: dict[str, str], options: argparse.Namespace) -> None:
    """Every answer of every tool into `out/answers`, case after case; none is begun after `options.minutes`."""
    end = time.monotonic() + 60.0 * options.minutes
    todo = [(tool, case) for case in hashes for tool in tools]

    def answer(tool: contest.Tool, case: str) -> str:
        if time.monotonic() > end:
            return f"{case} {tool.name}: no time is left"
        row = {"tool": tool.name, "case": case, **contest.run(tool, out / "cases" / case, options.cpu_seconds)}
        (out / "answers" / f"{case}--{tool.name}.json").write_text(json.dumps(row), encoding="utf-8")
        why = f": {row['why']}" if row["state"] == "failed" else ""
        return f"{case} {tool.name}: {row['state']} after {row['cpu_seconds']:.0f} s of a core{why}"

    with ThreadPoolExecutor(options.workers) as pool:
        jobs = [pool.submit(answer, *each) for each in todo]
        for done, job in enumerate(as_completed(jobs), start=1):
            print(f"{job.result()}, {done} of {len(jobs)}", file=sys.stderr, flush=True)


def _sim(out: Path, case: str) -> str:
    return (out / "cases" / case / "sim.xml").read_text(encoding="utf-8")


def score_row(row: Json, opened: Json, nominal: str) -> Json:
    """A row of the result: scores of one answer."""
    label, held = opened["label"], opened["heldout"]
    nameable = any(e["effect"] not in label["withheld"] for e in label["effects"])
    kept = {name: row.get(name, "") for name in ("tool", "case", "state", "why", "cpu_seconds")}
    made = {**kept, "stratum": label["stratum"], "kind": label["kind"], "nameable": nameable, "offers": []}
    scores: dict[str, float | None] = dict.fromkeys(each.key for each in score.SCORES)
    if row["state"] == "answered":
        answer = answer_from_json(row["answer"])
        made["offers"] = score.offers(answer)
        scores = score.judge(answer, label) | {"cpu_seconds": row["cpu_seconds"]}
        if answer.model is not None:
            of_arm = tuple(label["joints"]), label["kind"], held
            before, after = errors(nominal, *of_arm), errors(answer.model, *of_arm)
            scores |= {name: after[name] / before[name] for name in before}
    return {**made, "scores": scores}
