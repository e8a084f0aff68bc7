"""Whole turns that drives have lost: joints that read a position at which no joint can stand, before they get power.

An encoder that knows one turn of the drive's output tells after power-on where in a turn it stands, not in which. One
that woke in another turn reads a multiple of 2π too much or too little, at the joint by 2π / gear: mostly far beyond
the stops. Where a whole number of turns brings the reading between them, the zero that would do so is named.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from armlink.drives.findings import Result
from armlink.drives.orders import Power
from armlink.errors import BadInput, BusFault, Refused
from armlink.link.gate_limits import WINDOW_MARGIN, joint_ranges, target_window
from armlink.link.joints.values import JointValues

if TYPE_CHECKING:
    from armlink.link.cycle import Commander

MOST_NAMED = 4
"""So many zeros are named where several fit."""
MOST_CYCLES = 250
"""Cycles in which a reading must come before a joint gets power: 1 s at the usual rate."""
log = logging.getLogger("armlink")


@dataclass(frozen=True)
class Misplacement:
    """A joint whose drive reads a position at which it cannot stand."""

    joint: int
    name: str
    reading: float
    """[rad]."""
    stops: tuple[float, float]
    """[rad]."""
    zero: float
    """In force [rad at the drive's output]."""
    turns: tuple[int, ...]
    """Turns of the drive's output which, added to its zero, put the joint where it can stand; the likeliest first."""
    automatic: bool
    """Whether the arm file lets the host correct it (`turns: auto`)."""

    @property
    def remedy(self) -> str:
        if not self.turns:
            return (
                "No number of whole turns of its drive explains this reading, so zero, direction, gear, the "
                "stops or the scale of the reading are wrong: correct the arm file (`check --scales "
                "hand` judges the scale)"
            )
        zeros = [f"`zero: {self.zero_after(turns)}` ({_in_words(turns)})" for turns in self.turns]
        if len(self.turns) == 1:
            automatic = "" if self.automatic else " or `turns: auto`"
            return (
                f"Its drive has lost count of whole turns: write {zeros[0]}{automatic} in the `drive:` section "
                "of this joint in the arm file, or turn the joint back to where its drive was set up and switch "
                "the drive on again"
            )
        listed = " or ".join(zeros)
        if len(zeros) > MOST_NAMED:
            ends = " to ".join(f"`zero: {self.zero_after(turns)}`" for turns in (min(self.turns), max(self.turns)))
            listed = f"{zeros[0]} or another value of {ends}, in steps of {math.tau:.4f},"
        chosen = ", so `turns: auto` cannot choose" if self.automatic else ""
        return (
            f"Several numbers of whole turns of its drive explain this reading{chosen}: find out which number is "
            f"right, and write {listed} in the `drive:` section of this joint in the arm file"
        )

    @property
    def what(self) -> str:
        """The reading against the stops."""
        lower, upper = self.stops
        beyond = lower - self.reading if self.reading < lower else self.reading - upper
        stops = f"{lower:.4g} to {upper:.4g} rad"
        return (
            f"reads {self.reading:+.3f} rad, which is {beyond:.2f} rad beyond its stops ({stops}), where no joint "
            "can stand"
        )

    def zero_after(self, turns: int) -> str:
        """The zero that differs by so many turns, as one writes it in the arm file."""
        return f"{self.zero + math.tau * turns + 0.0:.4f}".replace("-0.0000", "0.0000")

    def __str__(self) -> str:
        return f"{self.name}: {self.what}. {self.remedy}"


class WholeTurns:
    """Tells which of an arm's joints cannot stand where they read, and corrects zeros where the arm file says so."""

    def __init__(self, arm: ArmFile, values: JointValues, stops: Sequence[tuple[float, float]]) -> None:
        """`values` are those whose zeros are corrected; `stops` of every joint [rad]."""
        self._joints, self._values, self._stops = arm.require_link().joints, values, tuple(stops)
        windows = np.array([target_window(*each) for each in stops])
        self._lower, self._upper = windows[:, 0] - WINDOW_MARGIN, windows[:, 1] + WINDOW_MARGIN
        """Ends of where a joint may read a position: what the gate bears under torque control."""
        self._automatic = [bool(getattr(each.settings, "turns", "") == "auto") for each in self._joints]

    @property
    def any_automatic(self) -> bool:
        """Whether the arm file lets the host correct some joint."""
        return any(self._automatic)

    def misplaced(self, positions: Sequence[float] | Array) -> list[Misplacement]:
        """Joints that cannot stand at these positions [rad]; one that is NaN says nothing."""
        found = []
        for joint in np.flatnonzero((positions < self._lower) | (positions > self._upper)).tolist():
            row, reading = self._joints[joint], float(positions[joint])
            turns, automatic = self._explaining(joint, reading), self._automatic[joint]
            zero = self._values.zero_of(joint)
            found.append(Misplacement(joint, row.name, reading, self._stops[joint], zero, turns, automatic))
        return found

    def _explaining(self, joint: int, reading: float) -> tuple[int, ...]:
        """Turns of the drive's output which, added to its zero, put the joint where it can stand.

        Whole turns of the joint come first: those of an encoder at the joint itself.
        """
        if not math.isfinite(reading):
            return ()
        gear, direction = self._values.gear[joint], self._values.direction[joint]
        least = math.ceil((reading - self._upper[joint]) / (math.tau / gear))
        most = math.floor((reading - self._lower[joint]) / (math.tau / gear))
        lost = sorted(range(least, most + 1), key=lambda turns: (turns % gear != 0, abs(turns)))
        return tuple(int(direction) * turns for turns in lost)

    def unnoticed(self) -> list[tuple[int, float]]:
        """Joints whose range is so wide that a lost turn may leave the reading between the stops; that turn [rad]."""
        found = []
        for joint, (lower, upper) in enumerate(self._stops):
            turn = math.tau / float(self._values.gear[joint])
            if lower + turn <= self._upper[joint] or upper - turn >= self._lower[joint]:
                found.append((joint, turn))
        return found

    def require(self, positions: Sequence[float] | Array) -> None:
        """Raise Refused where a joint cannot stand where it reads, naming every one."""
        found = self.misplaced(positions)
        if found:
            raise Refused("; ".join(str(each) for each in found))

    def results(self, positions: Sequence[float] | Array) -> list[Result]:
        """For `check`: whether each joint can stand where it reads; nothing of one that is NaN."""
        wrong = {each.joint: each for each in self.misplaced(positions)}
        found = []
        for joint, (row, reading) in enumerate(zip(self._joints, positions, strict=True)):
            if joint in wrong:
                told = f"{wrong[joint].what}. {wrong[joint].remedy}"
                found.append(Result(row.name, "position", "failed", told))
            elif math.isfinite(reading):
                note = self.note(joint)
                told = f"{reading:+.3f} rad, between the stops or close to them{note and '; '}{note}"
                found.append(Result(row.name, "position", "passed", told))
        return found

    def correct(self, positions: Sequence[float] | Array) -> list[Misplacement]:
        """Correct zeros by whole turns where the arm file has `turns: auto` and one number of turns alone explains the
        reading; the joints whose zeros were corrected."""
        found = [each for each in self.misplaced(positions) if each.automatic and len(each.turns) == 1]
        for each in found:
            self._values.turn_zero(each.joint, each.turns[0])
            log.warning("%s: %s: %s", each.name, each.what, self.note(each.joint))
        return found

    def note(self, joint: int) -> str:
        """The correction of a joint, in words; empty without one."""
        stated, used = self._joints[joint].settings.zero, self._values.zero_of(joint)
        if stated == used:
            return ""
        turns = round((used - stated) / math.tau)
        return f"zero {used:.4f} is used instead of {stated:g}, {_in_words(turns)} (`turns: auto`)"


def _in_words(turns: int) -> str:
    count = "a whole turn" if abs(turns) == 1 else f"{abs(turns)} whole turns"
    return f"{count} {'more' if turns > 0 else 'less'}"


def positions_before_power(commander: "Commander", set_up: Sequence[float], since: float) -> list[float]:
    """Position of each joint before it gets power [rad]: as its set-up found it at `since` (clock), or a newer reading.

    One that is older than a command may be is asked for by cycles in which every drive stays as it is. Raises BusFault.
    """
    loop, joints = commander.loop, range(commander.n)

    def outdated() -> list[int]:
        oldest = commander.clock.now() - commander.max_age
        return [joint for joint in joints if max(since, loop.seen[joint]) < oldest]

    for _ in range(MOST_CYCLES):
        if not outdated():
            break
        powered = [power in (Power.ON, Power.STOPPED) for power in commander.powers]
        commander.stand([Power.STOPPED if each else Power.OFF for each in powered])
    else:
        names = ", ".join(commander.names[joint] for joint in outdated())
        waited = f"no position was received for {MOST_CYCLES * commander.period:.1f} s"
        raise BusFault(f"{names}: {waited}, so no joint gets power: check power and wiring (`armlink scan`)")
    pairs = zip(loop.seen, loop.latest_position, set_up, strict=True)
    return [latest if seen > since and math.isfinite(latest) else first for seen, latest, first in pairs]


class PlaceWatch:
    """For those who only listen: tells once of each joint that it cannot stand where it reads, and refuses nothing."""

    def __init__(self, arm: ArmFile, values: JointValues, tell: Callable[[str], None] = log.warning) -> None:
        """Zeros in `values` are corrected with the first reading of each joint where the arm file says so."""
        self._values, self._tell = values, tell
        self._turns: WholeTurns | None = None
        self.found: dict[int, Misplacement] = {}
        """By joint, as of the newest positions."""
        try:
            self._turns = WholeTurns(arm, values, joint_ranges(arm))
        except BadInput as error:  # a model without ranges does not keep anybody from listening
            log.info("%s: the stops are not known, so no joint is checked for lost whole turns: %s", arm.name, error)
        self._unseen = np.ones(values.gear.size, bool)
        """Joints that no position came from yet."""

    def take(self, positions: Array) -> Array:
        """Positions (n,) [rad] as they are to be told: by corrected zeros."""
        if self._turns is None:
            return positions
        if self._unseen.any():
            first = np.where(self._unseen, positions, math.nan)
            self._unseen &= ~np.isfinite(positions)
            if corrected := self._turns.correct(first):
                positions = positions.copy()
                for each in corrected:
                    gear, direction = self._values.gear[each.joint], self._values.direction[each.joint]
                    positions[each.joint] -= direction * math.tau * each.turns[0] / gear
        found = {each.joint: each for each in self._turns.misplaced(positions)}
        for joint, each in found.items():
            if joint not in self.found:
                self._tell(str(each))
        silent = {joint: each for joint, each in self.found.items() if not math.isfinite(positions[joint])}
        self.found = silent | found
        return positions
