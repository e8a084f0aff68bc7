"""Data sets that are fitted together, as commands and programs give them."""

import logging
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from armlink.errors import BadInput
from calib.sweep.dataset import SweepData, load_data

log = logging.getLogger(__name__)


def data_sets(given: Sequence[Path | SweepData]) -> list[SweepData]:
    """Each data set, read from its folder where it is given as one; a warning for each that was ended early.

    Raises BadInput where one cannot be read, or where two hold the same readings, which would count twice.
    """
    found = [each if isinstance(each, SweepData) else load_data(each) for each in given]
    for number, each in enumerate(found):
        twin = next((other for other in found[:number] if other.readings and other.digest == each.digest), None)
        if twin is not None:
            raise BadInput(f"{each.path}: the same readings as {twin.path}, which would count twice: give one of them")
        if each.readings and (missing := _missing(each)):
            log.warning(
                "%s: ended before %s: fitted to what is there; to go on: armlink sweep %s --out %s --resume",
                *(each.path, missing, each.manifest.arm_file, each.path),
            )
    return found


def labels(paths: Sequence[Path]) -> list[str]:
    """Names of the data of these paths in records and findings: last names, or the paths where two have the same."""
    names = [path.resolve().name for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def digests(data: Sequence[SweepData]) -> dict[str, str]:
    """Label → SHA-256 of each data set, as records name their sources."""
    return dict(zip(labels([each.path for each in data]), [each.digest for each in data], strict=True))


def _missing(data: SweepData) -> str:
    """The first part that the sweep of a data set did not reach, in words; empty if it is whole."""
    if data.plan is None:
        return "its first sweep"
    made = Counter(reading.sweep for reading in data.readings)
    met = {stall.reading for stall in data.stalls if stall.contact}  # of creeping joints: not repeated
    for sweep in data.plan.sweeps:
        if sweep.name not in met and made[sweep.name] < (1 if sweep.speed else sweep.readings):
            return f"the end of sweep {sweep.name}"
    return ""
