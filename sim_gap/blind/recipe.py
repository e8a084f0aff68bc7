"""The cases of a blind check and how each is drawn: arm, effects, motions; all from one seed."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm, draw_arm
from sim_gap.blind.effects import DRAWS, EFFECTS
from sim_gap.blind.effects.drawn_effect import DrawnEffect
from sim_gap.blind.motion import KINDS, MotionLimits, trajectory
from sim_gap.blind.scene import Scene
from sim_gap.blind.true_arm import PlantRun, sound_arm

ATTEMPTS = 600
"""Number of arms drawn for a case before it is left out; backlash, the rarest, takes some hundred."""
OTHER_PAIR = 20
"""Number of arms drawn for two effects before two others are drawn."""
NONE_SHARE, TWO_SHARE = 0.12, 0.18
INDISTINCT = (
    {"actuator.lag", "actuator.delay"},
    {"link.payload", "link.mass_moment"},
    {"link.payload", "link.inertia"},
    {"link.mass_moment", "link.inertia"},
    {"transmission.elasticity", "transmission.backlash"},
    {"position.offset", "base.tilt"},
    {"position.offset", "position.eccentricity"},
    {"position.gain", "position.eccentricity"},
)
"""Effects not drawn together at one joint (or at the last one and the tip): slow motion cannot separate them."""


@dataclass(frozen=True)
class CaseRecipe:
    """One case before it is drawn: its effects by id; or the number of effects of a `several` case."""

    name: str
    effects: tuple[str, ...]
    seed: tuple[int, int]
    several: int = 0
    """Number of effects that are drawn for the arm, whichever it can show; 0 if `effects` names them."""

    @property
    def kind(self) -> str:
        """`none`, `single`, `two` or `several`."""
        return "several" if self.several else ("none", "single", "two")[len(self.effects)]


@dataclass(frozen=True)
class CaseDrawing:
    """One case drawn: the nominal arm, its effects, and the runs of the true arm."""

    recipe: CaseRecipe
    nominal: BenchArm
    drawn: tuple[DrawnEffect, ...]
    motions: dict[str, tuple[str, ...]]
    train: PlantRun
    heldout: PlantRun
    without: tuple[PlantRun, ...]
    """The held-out motion of the same arm without each effect in turn (of several: with each alone), then without any;
    one run for one effect."""
    attempt: int
    """Number of this drawing of the recipe."""
    columns: dict[str, bool]
    """Optional columns: `velocity`, `position_command`, `torque_command`."""


def recipes(seed: int, count: int, several: tuple[int, int] | None = None) -> list[CaseRecipe]:
    """`count` cases: every effect in turn, and among them arms without an effect and with two effects.

    With `several`, every case has a number of effects between these two, both included.
    """
    random = np.random.default_rng([seed, 0])
    if several:
        numbers = random.integers(several[0], several[1] + 1, count).tolist()
        return [CaseRecipe(f"case_{k:04d}", (), (seed, k + 1), number) for k, number in enumerate(numbers)]
    none, two = round(NONE_SHARE * count), round(TWO_SHARE * count)
    order = [*random.permutation(EFFECTS).tolist()]
    singles = [(order[k % len(order)],) for k in range(count - none - two)]
    pairs = [_pair(random) for _ in range(two)]
    mixed: list[tuple[str, ...]] = [*singles, *pairs, *([()] * none)]
    shuffled = [mixed[k] for k in random.permutation(len(mixed))]
    return [CaseRecipe(f"case_{k:04d}", effects, (seed, k + 1)) for k, effects in enumerate(shuffled)]


def _pair(random: np.random.Generator) -> tuple[str, ...]:
    return tuple(random.choice(EFFECTS, 2, replace=False).tolist())


def draw(recipe: CaseRecipe, train_s: float, heldout_s: float, first: int = 0) -> CaseDrawing | None:
    """Draw one case; arms that cannot show its effects are drawn again, None if there is none in `ATTEMPTS`.

    `first` is the number of the first attempt.
    """
    for attempt in range(first, first + ATTEMPTS):
        random = np.random.default_rng([*recipe.seed, attempt])
        if recipe.kind == "two" and attempt >= OTHER_PAIR:
            recipe = replace(recipe, effects=_pair(np.random.default_rng([*recipe.seed, attempt // OTHER_PAIR])))
        arm = draw_arm(random)
        limits = _limits(arm, random)
        held = str(random.choice(KINDS))
        others = [kind for kind in KINDS if kind != held]
        training = tuple(others if random.random() < 0.6 else [str(random.choice(others))])
        training += ("chirp",) * bool(random.random() < 0.5)
        scene = Scene(arm, trajectory(training, train_s, limits, random))
        drawn = _several(recipe.several, scene, random) if recipe.several else _named(recipe.effects, scene, random)
        if drawn is not None:
            command = trajectory((held,), heldout_s, limits, random)
            motions = {"train": training, "heldout": (held,)}
            return _assemble(recipe, scene, drawn, motions, command, random, attempt)
    return None


def _named(effects: tuple[str, ...], scene: Scene, random: np.random.Generator) -> tuple[DrawnEffect, ...] | None:
    """These effects on one arm; None if it cannot show one of them or they exclude each other."""
    drawn = [DRAWS[effect](scene, random) for effect in effects]
    found = tuple(d for d in drawn if d)
    return found if len(found) == len(drawn) and (len(found) < 2 or _compatible(*found)) else None


def _several(count: int, scene: Scene, random: np.random.Generator) -> tuple[DrawnEffect, ...] | None:
    """`count` different effects that the arm can show together; None if it cannot show as many."""
    found: list[DrawnEffect] = []
    tip = scene.arm.names[-1]
    for effect in random.permutation(EFFECTS).tolist():
        drawn = DRAWS[effect](scene, random)
        if drawn and all(_compatible(drawn, other) and _distinct(drawn, other, tip) for other in found):
            found.append(drawn)
        if len(found) == count:
            return tuple(found)
    return None


def _distinct(first: DrawnEffect, second: DrawnEffect, tip: str) -> bool:
    """Whether slow motion can separate two effects of one arm: a payload counts as one of the last joint, a tilt as one
    of any."""
    if {first.effect, second.effect} not in INDISTINCT:
        return True
    if "base.tilt" in (first.effect, second.effect):
        return False
    places = [{tip} if each.effect == "link.payload" else set(each.joints) for each in (first, second)]
    return not places[0] & places[1]


def _assemble(
    recipe: CaseRecipe,
    scene: Scene,
    drawn: tuple[DrawnEffect, ...],
    motions: dict[str, tuple[str, ...]],
    command: Array,
    random: np.random.Generator,
    attempt: int,
) -> CaseDrawing:
    nominal = scene.arm
    for effect in drawn:
        nominal = effect.nominal(nominal) if effect.nominal else nominal
    scene = Scene(nominal, scene.command)
    seed = int(random.integers(2**31))
    feed = {number: scene.feed_forward(q) for number, q in enumerate((scene.command, command))}

    whole = sound_arm(nominal, scene.rated, np.random.default_rng(seed))
    for effect in drawn:
        effect.apply(whole)
    bandwidth = whole.bandwidth  # the same controller for all runs

    def run(effects: tuple[DrawnEffect, ...], number: int) -> PlantRun:
        truth = sound_arm(nominal, scene.rated, np.random.default_rng(seed))
        for effect in effects:
            effect.apply(truth)
        truth.bandwidth = bandwidth
        return PlantRun(truth, (scene.command, command)[number], feed[number], scene.inertia, seed + number)

    columns = {name: bool(random.random() < share) for name, share in (("velocity", 0.5), ("position_command", 0.8))}
    late = any(effect.startswith("actuator") for effect in recipe.effects)
    columns["torque_command"] = late or bool(random.random() < 0.8)
    less = [tuple(d for d in drawn if d is not left) for left in drawn] if len(drawn) == 2 else []
    less = [(each,) for each in drawn] if recipe.several else less
    without = tuple(run(effects, 1) for effects in (*less, ()))
    return CaseDrawing(recipe, nominal, drawn, motions, run(drawn, 0), run(drawn, 1), without, attempt, columns)


def _limits(arm: BenchArm, random: np.random.Generator) -> MotionLimits:
    velocity = np.linspace(random.uniform(0.8, 1.3), random.uniform(1.5, 2.6), arm.n)
    acceleration = np.linspace(random.uniform(2.5, 4.0), random.uniform(6.0, 10.0), arm.n)
    return MotionLimits(arm.lower, arm.upper, velocity, acceleration)


def _compatible(first: DrawnEffect, second: DrawnEffect) -> bool:
    """Whether two effects can be combined: on a common joint, neither may overwrite the other."""
    same = set(first.joints) & set(second.joints)
    rewriting = {"transmission.coupling", "friction.stribeck", "friction.asymmetric", "transmission.elasticity"}
    rewriting |= {"transmission.backlash"}
    return not (same and (first.effect in rewriting or second.effect in rewriting))


def label(drawing: CaseDrawing) -> dict[str, Any]:
    """The true effects of the case, for the score; gaps are added once it has run."""
    chirp, nominal = "chirp" in drawing.motions["train"], drawing.nominal
    effects = [
        {
            "effect": d.effect,
            "joints": list(d.joints),
            "parameters": d.parameters,
            "axis": nominal.axis[nominal.names.index(d.joints[0])].tolist() if d.joints else None,
            "implied": list(d.implied),
            "undecided": "" if chirp and d.effect in ("actuator.lag", "actuator.delay") else d.undecided,
            "confused_with": list(d.confused_with),
        }
        for d in drawing.drawn
    ]
    return {
        "schema": "armlink.blind-label/1",
        "case": drawing.recipe.name,
        "kind": drawing.recipe.kind,
        "n": nominal.n,
        "effects": effects,
        "motions": {name: list(kinds) for name, kinds in drawing.motions.items()},
    }
