"""Examines an arm file, its model, this machine and the bus; says what is missing or doubtful, first things first."""

from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from armlink.arm_file import ArmFile, BadKeys, bundled_arms, load_arm
from armlink.drives.findings import Level, SetupFinding
from armlink.errors import ArmlinkError
from calib.commissioning.arm_text import assumed_lines
from calib.commissioning.bus_checks import bus_findings, silence_findings, turn_findings
from calib.commissioning.model_checks import model_findings
from calib.commissioning.model_judgement import arm_errors
from calib.commissioning.motion_checks import motion_findings
from gcomp.errors import GcompError

FORMATS = "docs/formats.md has every key with its unit and range"


def examine(arm: str, bus: str | None = None, offline: bool = False) -> list[SetupFinding]:
    """All findings, errors first, then in the order in which they are to be dealt with.

    `bus` replaces the arm file's; `offline` leaves the bus alone. The drives are only read.
    """
    return sorted(_all(arm, bus, offline), key=lambda found: get_args(Level).index(found.level))


def _all(arm: str, bus: str | None, offline: bool) -> Iterator[SetupFinding]:
    try:
        arm_file = load_arm(arm)
    except BadKeys as error:
        for key, message in error.keys:
            what, _, hint = message.partition("; did you mean ")
            remedy = f"did you mean {hint} Rename it" if hint else f"correct this key in the arm file: {FORMATS}"
            yield SetupFinding("error", what, f"{arm}: {key}", remedy)
        return
    except ArmlinkError as error:
        yield SetupFinding(
            "error", str(error), arm, "correct the arm file, or make a new one from a model (see new --help)"
        )
        return
    impossible = list[SetupFinding]()
    try:
        impossible += arm_errors(arm_file)
        yield from impossible
        if not impossible:
            yield from model_findings(arm_file)
            yield from motion_findings(arm_file)
    except (ArmlinkError, GcompError) as error:  # what later checks rest upon
        yield _as_finding(error, arm_file)
    if arm_file.link is None:
        yield SetupFinding(
            "error",
            "key `link` is missing: the bus and the drives of the joints are not known",
            arm,
            f"add the key `link`: {FORMATS}",
        )
    else:
        yield from _serial(arm_file)
        yield from turn_findings(arm_file)
        yield from silence_findings(arm_file)
        if not offline and not impossible:
            yield from bus_findings(arm_file, bus)
    yield from _assumed(arm, arm_file)


def _as_finding(error: Exception, arm_file: ArmFile) -> SetupFinding:
    what, _, remedy = str(error).removeprefix(f"{arm_file.path}: ").rpartition(": ")
    if not what:
        what, remedy = remedy, "correct the arm file or its model"
    return SetupFinding("error", what, str(arm_file.path), remedy)


def _serial(arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Records are kept under name and serial number: without one, two arms would share them."""
    if not arm_file.has_serial:
        yield SetupFinding(
            "warning",
            f"serial is {arm_file.serial}: another arm of this name would share the calibrations of this "
            "arm, so no calibration is written to its drives",
            str(arm_file.path),
            "give the arm a serial number before its first sweep (`serial: …`)",
        )


def _assumed(arm: str, arm_file: ArmFile) -> Iterator[SetupFinding]:
    """Values that armlink new assumed and nobody has confirmed yet."""
    if arm in bundled_arms():
        return
    assumed = assumed_lines(Path(arm_file.path).read_text(encoding="utf-8"))
    if assumed:
        yield SetupFinding(
            "hint",
            f"{len(assumed)} values are marked as assumed, the first is in line {assumed[0]}",
            str(arm_file.path),
            "check each of these values, then remove its comment",
        )
