"""Makes an arm file from a model: chain, ranges, drives; asks where somebody can answer, else assumes and says so."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from armlink.arm_file import MODEL_SUFFIXES, ArmFile, parse_arm
from armlink.content.atomic_file import write_whole
from armlink.content.file_content import MOST_YAML, parse_yaml, read_whole
from armlink.content.yaml_text import EditedYaml
from armlink.drives.findings import FoundDrives, SetupFinding
from armlink.errors import BadInput
from calib.arm.kinematics import gcomp_arm
from calib.commissioning.arm_text import arm_text
from calib.commissioning.bus_arm import drive_notes, with_gains
from calib.commissioning.chain import Chain, find_chains
from calib.commissioning.clear_range import clear_ranges, sweep_problem
from calib.commissioning.draft import Draft, JointDraft, draft_of_model, narrow
from calib.commissioning.drive_match import Ask, Match, TurnedJoint, match_by_hand, match_in_order
from calib.commissioning.model_checks import file_findings
from calib.commissioning.model_joints import model_joints
from calib.commissioning.model_judgement import model_errors
from calib.commissioning.motion_checks import largest_inertias

PLACES = ("node", "id", "reply", "direction", "zero")
"""Keys of a drive that come with the bus; the others are the arm file's own."""
RATING_FACTOR = 2.5
"""A drive whose rated torque differs from the model's effort limit by more is doubted; a choice."""


class Questions(Protocol):
    """Questions to a person at a terminal."""

    def which(self, chains: Sequence[Chain]) -> Chain: ...

    def stops(self, joint: str) -> tuple[float, float] | None:
        """Stops [rad] of a joint for which the model has none; None where they are not known."""
        ...


@dataclass
class NewArm:
    """An arm file about to be written, and how it came about."""

    out: Path
    draft: Draft
    findings: list[SetupFinding] = field(default_factory=list)

    @property
    def text(self) -> str:
        return arm_text(self.draft, self.out)

    def parsed(self) -> ArmFile:
        """The arm file, validated as if it lay there already."""
        return parse_arm(parse_yaml(self.text, self.out), self.out)

    def write(self) -> None:
        """Write the file; raises BadInput."""
        try:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self.out, self.text)
        except OSError as error:
            raise BadInput(f"{self.out}: cannot be written: {error.strerror}") from None


def new_arm(
    model: Path,
    out: Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    stops: Mapping[str, tuple[float, float]] | None = None,
    ratings: Mapping[str, float] | None = None,
    locked: Mapping[str, float] | None = None,
    name: str | None = None,
    questions: Questions | None = None,
) -> NewArm:
    """The arm file of a model, to stand at `out`; nothing is written. Raises BadInput, BadModel, Refused.

    The longest chain of revolute joints is the arm, or the one from body `base` to body `tip`. A gripper, mimic and
    prismatic joints at its end and the joints that carry `base` keep the model's position. Where sweeps within the
    model's limits would collide, a narrower range is chosen. `ratings` [N·m] by joint name replace the model's efforts;
    joints in `locked` are held at that position [rad, m] and are none of the arm's.
    """
    if model.suffix.lower() not in MODEL_SUFFIXES:
        raise BadInput(f"{model}: expected a URDF or MJCF model ({', '.join(MODEL_SUFFIXES)})")
    if not model.is_file():
        raise BadInput(f"there is no model file {model}: give the path of a URDF or MJCF file")
    joints, gravity = model_joints(model, locked)
    _refuse_other_joints("--lock", locked or {}, [joint.name for joint in joints], f"in {model}")
    chains = find_chains(joints, model, base, tip)
    chain = chains[0] if questions is None or len(chains) == 1 else questions.which(chains)
    given = _given_stops(chain, dict(stops or {}), model, questions)
    names = [joint.name for joint in chain.joints]
    _refuse_other_joints("--rated-torque", ratings or {}, names, f"of the arm in {model}")
    draft = draft_of_model(model, chain, gravity, given, ratings, locked)
    if len(chains) > 1 and questions is None:
        others = ", ".join(each.tip for each in chains if each is not chain)
        draft.notes.append(
            f"tip assumed: the model has {len(chains)} arms; choose another arm by its last body, {others} (--tip)"
        )
    draft.name = name or draft.name
    made = NewArm(out, draft)
    for found in model_errors(made.parsed()):
        raise BadInput(str(found))
    _narrow_until_clear(made)
    made.findings += file_findings(made.parsed())
    return made


def _narrow_until_clear(made: NewArm) -> None:
    """Narrow the ranges until no sweep collides; raises BadInput or Refused as planning does where none is clear."""
    arm_file = made.parsed()
    problem = sweep_problem(arm_file)
    if problem is None:
        return
    for clear in clear_ranges(arm_file, problem):
        narrow(made.draft, clear)
        if sweep_problem(made.parsed()) is None:
            return
    raise problem


def _given_stops(
    chain: Chain, stops: dict[str, tuple[float, float]], model: Path, questions: Questions | None
) -> dict[str, tuple[float, float]]:
    names = [joint.name for joint in chain.joints]
    _refuse_other_joints("--stops", stops, names, f"of the arm in {model}")
    for joint in chain.joints:
        if joint.limits is None and joint.name not in stops and questions is not None:
            answer = questions.stops(joint.name)
            if answer is not None:
                stops[joint.name] = answer
    return stops


def _refuse_other_joints(option: str, given: Mapping[str, object], names: Sequence[str], place: str) -> None:
    for name in given:
        if name not in names:
            raise BadInput(f"{option} {name}: there is no such joint {place}; there are {', '.join(names)}")


def match_drives(made: NewArm, drives: FoundDrives, bus: str, ask: Ask | None) -> list[Match]:
    """Find the drive of every joint and take its node, identity and ratings into the draft; raises BusFault, BadInput.

    With `ask` each joint is turned by hand, else the order of node ids counts.
    """
    names = [joint.name for joint in made.draft.joints]
    if ask is None:
        matches = match_in_order(names, drives, bus)
    else:
        arm = gcomp_arm(made.parsed())
        turned = [TurnedJoint(*each) for each in zip(arm.names, arm.lower, arm.upper, strict=True)]
        matches, findings = match_by_hand(turned, drives, bus, ask)
        made.findings += findings
    damped = any(match.drive.largest_gains is not None for match in matches)
    inertias = largest_inertias(made.parsed()) if damped else {}
    for joint, match in zip(made.draft.joints, matches, strict=True):
        drive = with_gains(match.drive, inertias.get(joint.name, 0.0))
        joint.node, joint.drive = drive.node, drive
        joint.notes += drive_notes(drive, rating=False)
        if math.isfinite(drive.rated_torque):
            _take_ratings(made, joint, match)
        elif math.isfinite(drive.max_torque):
            joint.max_torque = min(joint.max_torque, drive.max_torque)
        joint.max_torque_rate = float(f"{2.5 * joint.max_torque:.3g}")
        joint.notes.append(
            "node found by turning the joint by hand"
            if match.by_hand
            else "node assumed: taken in the order of the node ids"
        )
    return matches


def _take_ratings(made: NewArm, joint: JointDraft, match: Match) -> None:
    """Rating, limit and identity as the drive tells them."""
    drive = match.drive
    ratio = drive.rated_torque / joint.rated_torque
    from_model = not any(note.startswith("rated_torque assumed: ") for note in joint.notes)
    if from_model and not 1 / RATING_FACTOR < ratio < RATING_FACTOR:
        made.findings.append(_doubtful_rating(match, joint.rated_torque))
    joint.rated_torque = drive.rated_torque
    joint.max_torque = min(joint.max_torque, drive.max_torque) if from_model else drive.max_torque
    joint.identity = {"vendor": drive.vendor, "product": drive.product}
    joint.notes = [note for note in joint.notes if not note.startswith("rated_torque")]


def _doubtful_rating(match: Match, effort: float) -> SetupFinding:
    drive = match.drive
    remedy = "check that this drive moves this joint" + (
        "" if match.by_hand else " (--by-hand finds the drive of each joint)"
    )
    what = f"the drive is rated {drive.rated_torque:g} N·m, but the effort limit of the model is {effort:g} N·m"
    return SetupFinding("warning", what, f"{match.joint} ({drive.address})", remedy)


def rewired_text(arm: ArmFile, matches: Sequence[Match], bus: dict[str, str | int], out: Path) -> str:
    """An arm file's text, to stand at `out`, with the drives found on a bus; its comments and its order stay.

    Of each joint it writes node, rated torque and identity, and the bus.
    """
    edited = EditedYaml(read_whole(arm.path, MOST_YAML).decode())
    link: Any = edited.content["link"]
    for row, match in zip(link["joints"], matches, strict=True):
        drive = match.drive
        family = row["drive"]["family"] if "drive" in row else "canopen"
        if drive.family != family:
            what = f"{row['name']} has a drive of family {family}, {drive.address} is one of family {drive.family}"
            raise BadInput(f"{arm.path}: {what}: disconnect the others, or correct link.joints")
        if family != "canopen":
            row["drive"].update({key: value for key, value in (drive.drive or {}).items() if key in PLACES})
            continue
        if "drive" in row:
            row["drive"]["node"] = drive.node
        elif drive.drive is None:
            row["node"] = drive.node
        else:
            del row["node"]
            row["drive"] = edited.in_line(drive.keys["drive"])
        row["rated_torque"] = drive.rated_torque
        row["max_torque"] = min(float(row["max_torque"]), drive.max_torque)
        row["identity"] = edited.in_line({"vendor": drive.vendor, "product": drive.product})
    link["bus"] = edited.in_line(bus)
    if arm.model_path is not None:
        edited.content["kinematics"]["model"] = os.path.relpath(arm.model_path, out.resolve().parent)
    return edited.text
