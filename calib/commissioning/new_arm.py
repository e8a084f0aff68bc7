"""Makes an arm file from a model: chain, ranges, drives; asks where somebody can answer, else assumes and says so.

An arm that touches itself or its surroundings within its model's limits gets narrower ranges.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from armlink.arm_file import ArmFile, parse_arm
from armlink.content.atomic_file import write_whole, writing
from armlink.content.file_content import parse_yaml
from armlink.drives.findings import FoundDrives, SetupFinding
from armlink.errors import ArmlinkError, BadInput
from armlink.model_file import MODEL_SUFFIXES
from calib.arm.kinematics import model_arm, model_chain
from calib.commissioning.chain import Chain, ModelJoint, find_chains, model_joints
from calib.commissioning.draft import Draft, arm_text, draft_of_model
from calib.commissioning.drive_match import Ask, match_drives, wired_text
from calib.commissioning.model_checks import file_findings, model_errors
from calib.plan.collisions import Geometry, check_plan
from calib.plan.rough_gravity import guess_of_file
from calib.plan.sweep_plan import plan_sweep
from gcomp.arm.arm import Arm
from gcomp.arrays import Array
from gcomp.errors import GcompError

WIDTH_SHARES = (0.8, 0.65, 0.5, 0.4, 0.3, 0.22, 0.16)
"""Widths of the range that are tried, as shares of the model's."""
CENTRES = 80
"""Drawn poses about which a range is looked for, besides the middle of the joints' and the model's own pose."""
SKETCH, PROOF = 40, 400
"""Poses at which a range is looked at while choosing and in the end; half of them are corners."""


def clear_ranges(arm_file: ArmFile) -> Iterator[tuple[Array, Array]]:
    """Lower and upper ends (n,) [rad] of joint ranges without collision at every pose looked at here, widest first.

    One of each width; a later one is for arms whose sweeps collide all the same, between these poses.
    """
    geometry = Geometry(arm_file)
    if geometry.model.ngeom == 0:
        return
    placed, generator = model_chain(arm_file), np.random.default_rng(0)
    arm = model_arm(arm_file, placed).arm
    own = np.clip(placed.reference, arm.lower, arm.upper)
    drawn = generator.uniform(arm.lower, arm.upper, (CENTRES, arm.n))
    centres = np.concatenate([[(arm.lower + arm.upper) / 2, own], drawn])
    centres = centres[geometry.free(centres)]
    for share in WIDTH_SHARES:
        boxes = [_box(arm, centre, share) for centre in centres]
        for low, high in boxes:
            sketched = geometry.free(_poses((low, high), SKETCH, generator)).all()
            if sketched and geometry.free(_poses((low, high), PROOF, generator)).all():
                yield low, high
                break


def sweep_problem(arm_file: ArmFile) -> Exception | None:
    """The error that planning the sweeps ends with, None if it succeeds."""
    guess = guess_of_file(arm_file)
    try:
        for seed in (0, 1):  # plans that must be clear for a range to be kept
            check_plan(arm_file, plan_sweep(arm_file, seed=seed))
            check_plan(arm_file, plan_sweep(arm_file, guess, seed=seed))
    except (ArmlinkError, GcompError) as error:
        return error
    return None


def _box(arm: Arm, centre: Array, share: float) -> tuple[Array, Array]:
    """`share` of the range about `centre`, moved within the limits."""
    half = share * (arm.upper - arm.lower) / 2
    middle = np.clip(centre, arm.lower + half, arm.upper - half)
    return middle - half, middle + half


def _poses(box: tuple[Array, Array], count: int, generator: np.random.Generator) -> Array:
    low, high = box
    shares = generator.random((count, len(low)))
    shares[: count // 2] = np.round(shares[: count // 2])
    return low + shares * (high - low)


class Questions(Protocol):
    """Questions to a person at a terminal."""

    def which(self, chains: Sequence[Chain]) -> Chain: ...

    def stops(self, joint: ModelJoint) -> tuple[float, float] | None:
        """Stops [rad] of a joint for which the model has none; None where they are not known."""


@dataclass
class NewArm:
    out: Path
    draft: Draft
    findings: list[SetupFinding] = field(default_factory=list)
    wired: str = ""
    """The text with the drives of a bus."""

    @property
    def text(self) -> str:
        return self.wired or arm_text(self.draft, self.out)

    def parsed(self) -> ArmFile:
        """The arm file, validated as if it lay there already."""
        return parse_arm(parse_yaml(self.text, self.out), self.out)

    def wire(self, drives: FoundDrives, channel: str, ask: Ask | None, bus: dict[str, Any] | None = None) -> None:
        """Find the drive of every joint and take it into the text; raises BusFault, BadInput."""
        arm = self.parsed()
        matches, findings = match_drives(arm, drives, channel, ask)
        self.wired, doubts = wired_text(self.text, arm, matches, self.out, bus)
        self.findings += findings + doubts

    def write(self) -> None:
        """Write the file; raises BadInput."""
        with writing(self.out):
            self.out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self.out, self.text)


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
    draft = draft_of_model(name or out.stem, model, chain, gravity, given, ratings, locked)
    if len(chains) > 1 and questions is None:
        others = ", ".join(each.tip for each in chains if each is not chain)
        draft.notes.append(
            f"tip assumed: the model has {len(chains)} arms; choose another arm by its last body, {others} (--tip)"
        )
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
    reason = str(problem).removeprefix(f"{arm_file.name}: ").partition(": narrow")[0]
    for lower, upper in clear_ranges(arm_file):
        for joint, low, high in zip(made.draft.joints, lower, upper, strict=True):
            joint.stops = (math.ceil(low * 1000) / 1000, math.floor(high * 1000) / 1000)
        made.draft.servo = f"the ranges under kinematics.stops are narrower than the model's limits ({reason})"
        if sweep_problem(made.parsed()) is None:
            why = "; narrowed, so that no sweep collides"
            for joint in made.draft.joints:
                joint.notes = [note + why * note.startswith("stops assumed") for note in joint.notes]
            return
    raise problem


def _given_stops(
    chain: Chain, stops: dict[str, tuple[float, float]], model: Path, questions: Questions | None
) -> dict[str, tuple[float, float]]:
    names = [joint.name for joint in chain.joints]
    _refuse_other_joints("--stops", stops, names, f"of the arm in {model}")
    for joint in chain.joints:
        if not joint.has_stops and joint.name not in stops and questions is not None:
            answer = questions.stops(joint)
            if answer is not None:
                stops[joint.name] = answer
    return stops


def _refuse_other_joints(option: str, given: Mapping[str, object], names: Sequence[str], place: str) -> None:
    for name in given:
        if name not in names:
            raise BadInput(f"{option} {name}: there is no such joint {place}; expected one of {', '.join(names)}")
