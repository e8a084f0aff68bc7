"""The self-test of an arm's drives: what they are, what they hold, and what they do when their host falls silent.

A family may have one of its own, for an arm that has no other drives; this one is for all families. What each device
does, and how long it takes, is measured, not believed.
"""

from collections.abc import Callable

import numpy as np

from armlink.arm_file import ArmFile
from armlink.drives.findings import ANSWER_CYCLES, HOLD_TOLERANCE, SILENCE_DEADLINES, Checks, Result, count_answers
from armlink.drives.orders import Power
from armlink.drives.traits import Silence
from armlink.errors import ArmlinkError, BusFault, Refused
from armlink.link.joints.groups import by_joint, make_groups, traits_of
from armlink.link.link import Link
from armlink.link.park import cycle_count, falling_joints, park, path_speeds, straight_path
from armlink.link.types import Command, Sample, Tell

CHECKS = ("set-up", "position", "answers", "enables and holds", "silence", "park")
HOLD_SECONDS = 0.5
FALL_LIMIT = 0.5
"""A joint whose drive falls free may move this far in the test of its silence [rad]."""
LEAN_ANGLE = 0.2
"""So far a joint is led to where gravity pulls at it, if its drive does not tell its state [rad], and within 2 s."""
KEEPS_ON = "nothing stops this joint when its host dies: do not drive it"
ASKED_CYCLES = 5
"""Cycles that a drive has to tell its state when it is asked."""


def announcement(arm: ArmFile) -> str:
    """The test with power in sentences, for a person who is asked before it begins."""
    groups, deadline, keeper = make_groups(arm), arm.require_link().deadline * 1e3, arm.require_link().keeper
    traits, drives = traits_of(groups), dict[str, list[str]]()
    for name, (group, _), each in zip(arm.joint_names, by_joint(groups), traits, strict=True):
        drives.setdefault(f"{each.reaction(keeper)} ({group.family.name})", []).append(name)
    steps = groups[0].family.self_test_steps.format(deadline=deadline) if len(groups) == 1 else ""
    if not steps:
        told = "; ".join(f"{', '.join(names)}: {drive}" for drive, names in drives.items())
        steps = (
            f"One joint after the other then gets no commands for up to {SILENCE_DEADLINES * deadline:.0f} ms, until "
            f"its drive reacts. The expected reactions are: {told}. A joint whose drive does not report its state is "
            f"first turned by {LEAN_ANGLE} rad."
        )
        if any(each.silence != each.reaction(keeper) for each in traits):
            steps += (
                f" Finally, no joint gets commands for {SILENCE_DEADLINES * deadline:.0f} ms: the keeper must hold "
                "every joint whose drive continues its last command."
            )
    end = "the joints hold, in quick stop"
    if not all(each.silence == "holds" for each in traits):
        end = "the arm is parked or slowly lowered, and its power is switched off"
    return (
        f"This test enables every joint of {arm.name} and lets it hold where it stands (with at most its max_torque). "
        f"{steps} At the end {end}. A drive that reacts in another way may let its joint fall: put the arm where no "
        "joint can fall, keep clear, and keep a hand on the emergency stop."
    )


def self_test(link: Link, tell: Tell, power: bool) -> tuple[list[Result], str]:
    """Run the checks on a link that is open and not started; results, and the bus's name. Raises BusFault."""
    return SelfTest(link, tell).run(power), str(link.bus.channel_info)


class SelfTest:
    """Runs the checks on an arm's drives; the link must not be started."""

    def __init__(self, link: Link, progress: Callable[[str], None] = lambda text: None) -> None:
        """`progress` is told what is being done."""
        self.link, self.progress = link, progress
        self.checks = Checks()
        self._parked = False
        self._under_way = "answers"
        """The check that an error of the bus ends."""

    def run(self, power: bool) -> list[Result]:
        """All checks; those with power only where `power`, and where all before them passed.

        Raises BusFault where another host is on the bus.
        """
        link = self.link
        own = link.groups[0].family.self_test if len(link.groups) == 1 else None
        if own is not None:
            link.correct_turns()
            limits = [link.values.limits(joint, limit) for joint, limit in enumerate(link.limits)]
            return own(link, link.groups[0].drives, limits, power, self.progress)
        reason = "the checks with power were not requested"
        try:
            if not self._identified():
                reason = "a drive does not answer, or is not the drive of the arm file"
            elif not self._started():
                reason = "a check without power failed"
            elif power:
                reason = self._watched() or self._with_power()
        except ArmlinkError as error:
            reason = str(error)
            if self.checks.results and not self.checks.failed:
                self.checks.add(self._blamed(reason), self._under_way, "failed", reason)
        finally:
            if link.enabled:
                link.stop()
            elif link.commander.passed and not self._parked:
                link.commander.stop()
        for name, check in self.checks.missing(CHECKS, link.names):
            self.checks.add(name, check, "not run", reason)
        return self.checks.results

    def _blamed(self, reason: str) -> str:
        """The joint that a reason begins with, alone or with its address in brackets; else the first."""
        names = self.link.names
        return next((name for name in names if reason.startswith((f"{name}:", f"{name} ("))), names[0])

    def _identified(self) -> bool:
        """Each drive answers and is the one that the arm file states."""
        self.progress("identity")
        good = True
        for each in self.link.scan():
            name = self.link.names[each.joint]
            if not each.present:
                self.checks.add(name, "answers", "failed", f"no answer of {each.address}")
            elif each.mismatch:
                self.checks.add(name, "identity", "failed", each.mismatch)
            else:
                told = " ".join(part for part in (each.name, each.serial, each.firmware) if part)
                self.checks.add(name, "identity", "passed", told or each.address)
                continue
            good = False
        return good

    def _started(self) -> bool:
        """The set-up, with all that is read back, and readings in every cycle without power."""
        link = self.link
        self.progress("set-up")
        try:
            link.start()
        except BusFault as error:
            self.checks.add(self._blamed(str(error)), "set-up", "failed", str(error))
            return False
        except Refused as error:
            if not link.setups or not self._places():
                raise
            self.progress(str(error))
            return False
        for name, setup in zip(link.names, link.setups, strict=True):
            scales = ", ".join(f"{what} {value:.6g}" for what, value in setup.scales.items())
            self.checks.add(name, "set-up", "passed", "; ".join((*setup.notes, scales)) or "read back")
            for lost in setup.lost:
                self.checks.add(name, f"lacks: {lost.partition(':')[0]}", "absent", lost)
        self._places()
        self._calibrations()
        off, commander, loop = [Power.OFF] * link.n, link.commander, link.commander.loop
        cycle, late = lambda: commander.stand(off).position, lambda: loop.listen(ANSWER_CYCLES * link.period)
        answers = count_answers(loop.board, cycle, ANSWER_CYCLES, late)
        for name, (good, found) in zip(link.names, answers, strict=True):
            self.checks.judge(name, "answers", good, found)
        return all(good for good, _ in answers)

    def _places(self) -> bool:
        """Whether each joint can stand where it reads; returns whether one cannot."""
        results = self.link.turns.results(self.link.set_up_positions)
        self.checks.results += results
        return any(each.outcome == "failed" for each in results)

    def _calibrations(self) -> None:
        """Calibrations that the host keeps: which record is in force, or that there is none."""
        link = self.link
        for joint, (name, traits) in enumerate(zip(link.names, traits_of(link.groups), strict=True)):
            if traits.calibration != "host":
                continue
            held = link.read_calibration(joint)
            if name in link.uncalibrated:
                told = "there is no current calibration record: the torque is used as the drive reports it"
                self.checks.add(name, "calibration", "absent", told)
            else:
                told = f"gain {held.gain:.6g}, offset {held.offset:.4g} N·m, record {held.record_id}"
                self.checks.add(name, "calibration", "passed", told)

    def _watched(self) -> str:
        """Why the joints are not driven: a drive that is known to keep on when its host falls silent; else empty."""
        pairs = zip(self.link.names, traits_of(self.link.groups), strict=True)
        keeping = [name for name, each in pairs if each.reaction(self.link.section.keeper) == "keeps on"]
        for name in keeping:
            self.checks.add(name, "silence", "failed", KEEPS_ON)
        if not keeping:
            return ""
        return f"{keeping[0]} is not driven: if its host died, its drive would keep on with the last command"

    def _with_power(self) -> str:
        """Enable, hold, silence of each drive, stow; returns why what is left is not run."""
        link, self._under_way = self.link, "enables and holds"
        self.progress("enabling the joints, which should hold")
        start = link.clock.now()
        standing = link.enable().position
        seconds = link.clock.now() - start
        on, most = [Power.ON] * link.n, HOLD_TOLERANCE + self._sags()
        sample = self._cycle(on, standing, most)
        for _ in range(cycle_count(link, HOLD_SECONDS)):
            sample = self._cycle(on, standing, most)
        moved = np.abs(sample.position - standing)
        for joint, name in enumerate(link.names):
            found = f"moved by {moved[joint]:.4f} rad in {HOLD_SECONDS} s"
            self.checks.add(name, "enables and holds", "passed", found, seconds)
        self._under_way = "silence"
        kept = [joint for joint, each in enumerate(traits_of(link.groups)) if each.silence == "keeps on"]
        for joint in range(link.n):
            if joint not in kept:
                self._silence(joint)
        if kept:
            self._keeper(kept)
        self._under_way = "park"
        return self._park()

    def _sags(self) -> np.typing.NDArray[np.float64]:
        """How far a load of the rated torque moves each joint that a position gain holds, until the integral term
        has taken the load over, (n,) [rad]; 0 where the drive closes the loop."""
        pairs = zip(self.link.section.joints, self.link.commander.limits, strict=True)
        return np.array([joint.rated_torque / limit.kp if limit.kp else 0.0 for joint, limit in pairs])

    def _park(self) -> str:
        """Stow the arm where drives let go without their host; returns why it is not stowed."""
        link = self.link
        letting_go = falling_joints(link)
        if not letting_go:
            return "every drive holds when its host is silent"
        if link.section.park is None:
            lack = "the arm file has no `link.park`"
            for name in letting_go:
                self.checks.add(name, "park", "absent", f"{lack}: the arm is slowly lowered when the work ends")
            return lack
        start = link.clock.now()
        try:
            park(link, self.progress)
        except Refused as error:
            self.checks.add(link.names[0], "park", "failed", str(error))
            return str(error)
        self._parked, seconds = True, link.clock.now() - start
        for name in link.names:
            self.checks.add(name, "park", "passed", "parked, power off", seconds)
        return ""

    def _silence(self, joint: int) -> None:
        """No command for one joint, all others commanded as before: what does its drive do, and is that its trait?"""
        link = self.link
        name, trait = link.names[joint], traits_of(link.groups)[joint].silence
        does, seconds = self._left_alone(joint)
        if does is None:  # its drive tells no state: it shows it where gravity pulls
            self._lean(joint)
            does, seconds = self._left_alone(joint)
        if does is None:
            found = (
                "its drive reports no state, and the joint carries no load in this pose: repeat the check "
                "in a pose where gravity loads the joint"
            )
            self.checks.add(name, "silence", "not run", found)
            return
        told = (
            f"{does} within {seconds * 1e3:.0f} ms without a command; the trait `silence` of its family says "
            f"that it {trait}"
        )
        if does == "keeps on":
            told += f": {KEEPS_ON}"
        good = does == trait or (does, trait) == ("holds", "damps")
        self.checks.judge(name, "silence", good, told, seconds)

    def _keeper(self, kept: list[int]) -> None:
        """No command for any joint: does the keeper hold those whose drives would keep on with their last one?"""
        link, loop = self.link, self.link.commander.loop
        seconds, left = SILENCE_DEADLINES * link.section.deadline, "; no keeper helps if the machine or a cable fails"
        if loop.keeper is None:
            for joint in kept:
                told = f"its drive keeps on with its last command, and no keeper is needed in a simulation{left}"
                self.checks.add(link.names[joint], "silence", "absent", told)
            return
        self.progress(f"no commands for {seconds * 1e3:.0f} ms: the keeper holds the joints")
        standing, loop.keeper.heard = np.array(loop.latest_position), False
        loop.listen(seconds)
        moved = np.abs(np.array(loop.latest_position) - standing)
        for joint in kept:
            heard = "sent its frames" if loop.keeper.heard else "was not heard"
            told = f"its keeper {heard} within {seconds * 1e3:.0f} ms; the joint moved by {moved[joint]:.4f} rad{left}"
            held = loop.keeper.heard and bool(moved[joint] < HOLD_TOLERANCE)
            self.checks.judge(link.names[joint], "silence", held, told)
        link.commander.settle()
        link.commander.walk(Power.ON)

    def _lean(self, joint: int) -> None:
        """Lead a joint away from where it hangs, towards the middle of its way."""
        link = self.link
        start = np.array(link.commander.loop.latest_position)
        goal, middle = start.copy(), (link.limits[joint].lower + link.limits[joint].upper) / 2
        goal[joint] += LEAN_ANGLE if middle > start[joint] else -LEAN_ANGLE
        for target in straight_path(start, goal, path_speeds(link, LEAN_ANGLE), link.period):
            link.cycle(Command.hold(target))

    def _left_alone(self, joint: int) -> tuple[Silence | None, float]:
        """The drive's reaction to no commands, None where it does not tell, and its delay [s]; then it is ON."""
        link, limit = self.link, self.link.section.deadline
        group, drive = by_joint(link.groups)[joint]
        self.progress(f"{link.names[joint]}: sending no commands for {limit * 1e3:.0f} ms")
        loop, on = link.commander.loop, [Power.ON] * link.n
        standing = np.array(loop.latest_position)
        loop.withheld = frozenset([joint])
        found, seconds = Power.ON, 0.0
        start = link.clock.now()
        try:
            while found is Power.ON and seconds < SILENCE_DEADLINES * limit:
                self._cycle(on, standing, FALL_LIMIT)
                seconds = link.clock.now() - start
                found = group.drives.power(drive)
            if found is Power.ON:  # a drive that answers commands alone is asked
                for can_id, data in group.drives.state_request(drive):
                    loop.send(can_id | group.tag, data)
                for _ in range(ASKED_CYCLES):
                    self._cycle(on, standing, FALL_LIMIT)
                found = group.drives.power(drive)
            moved = float(abs(loop.latest_position - standing)[joint])
            does = None if found is Power.UNKNOWN else self._reaction(found, group.drives.lets_go(drive), moved)
        finally:
            loop.withheld = frozenset()
        link.commander.settle()
        link.commander.walk(Power.ON)
        return does, seconds

    @staticmethod
    def _reaction(found: Power, free: bool, moved: float) -> Silence:
        """The reaction of a drive by its power state, whether its motor is `free`, and its motion [rad]."""
        if found is Power.ON:
            return "keeps on"
        if free:
            return "falls"
        return "holds" if moved < HOLD_TOLERANCE else "damps"

    def _cycle(
        self, power: list[Power], standing: np.typing.NDArray[np.float64], most: float | np.typing.NDArray[np.float64]
    ) -> Sample:
        """One cycle; raises BusFault where the bus has a fault or a joint moves too far."""
        link = self.link
        sample = link.commander.stand(power)
        link.require_sound_bus()
        moved = np.abs(np.array(link.commander.loop.latest_position) - standing)
        if (moved > most).any():
            joint = int(np.nanargmax(moved - most))
            limit = np.broadcast_to(most, moved.shape)[joint]
            text = f"moved by {moved[joint]:.3f} rad while it should hold (limit {limit:.3g} rad)"
            raise BusFault(
                f"{link.names[joint]}: {text}, so the test was ended: check its load, its brake and its gains"
            )
        return sample
