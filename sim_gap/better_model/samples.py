"""Draws of all fitted parameters, so that a training run randomises over what the recordings leave open."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armlink.content.atomic_file import open_whole, write_whole
from armlink.errors import BadInput
from sim_bus.effects.registry import effects as simulated
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

SUFFIXES = (".csv", ".json", ".parquet")
LEAST_DRAW_SHARE = 0.01
"""A draw of a parameter that must be above zero is at least this share of its estimate."""


def drawn_parameters(
    estimate: EffectEstimate, names: Sequence[str], count: int, seed: int = 0
) -> list[dict[str, float]]:
    """Draws of what the arm has, `JOINT.EFFECT.PARAMETER` → value in SI units; effects on the whole arm are `arm.…`.

    What only some recordings have, such as a body in the hand, is left out. Values are kept within what the simulated
    arm accepts: no friction, rotor or play is below zero.
    """
    terms = [term for term in estimate.terms if not term.bound]
    best = {term: {name: each.value for name, each in estimate.parameters(term).items()} for term in terms}

    def label(term: Term) -> str:
        return f"{'arm' if term.form.signature.whole_arm else names[term.place]}.{term.effect}"

    return [
        {
            f"{label(term)}.{name}": _accepted(term.effect, name, value, best[term][name])
            for term, values in row.items()
            for name, value in values.items()
        }
        for row in estimate.draws(terms, count, seed)
    ]


def _accepted(effect: str, name: str, value: float, best: float) -> float:
    """A value within the bounds that the simulated arm has for it."""
    known = simulated().get(effect)
    one = next((each for each in known.parameters if each.name == name), None) if known else None
    if one is None or not one.accepts(best):
        return value
    least, above = one.domain.least, one.domain.above
    value = value if least is None else max(value, least)
    return value if above is None else max(value, above + LEAST_DRAW_SHARE * (best - above))


def write_rows(rows: Sequence[Mapping[str, float]], path: Path) -> None:
    """Write draws, one row each, as CSV, JSON or Parquet. Raises BadInput."""
    if path.suffix not in SUFFIXES:
        raise BadInput(f"--out-samples {path}: expected a name that ends in {', '.join(SUFFIXES)}")
    names = list(rows[0]) if rows else []
    try:
        if path.suffix == ".json":
            text = json.dumps({"schema": "armlink.samples/1", "samples": [dict(row) for row in rows]}, indent=1)
            write_whole(path, text)
        elif path.suffix == ".csv":
            lines = [",".join(names), *(",".join(f"{row[name]:.9g}" for name in names) for row in rows)]
            write_whole(path, "\n".join(lines) + "\n")
        else:
            import pyarrow as pa
            from pyarrow.parquet import write_table

            table = pa.table({name: np.array([row[name] for row in rows]) for name in names})
            with open_whole(path) as stream:
                write_table(table, stream)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror}") from None
