"""The cases of a blind check and how each is drawn: arm, effects, motions; all from one seed."""

from dataclasses import dataclass, replace

import numpy as np

from gcomp.arrays import Array
from sim_gap.blind.arms import BenchArm, draw_arm
from sim_gap.blind.effects import DRAWS, EFFECTS, controller
from sim_gap.blind.effects.drawn_effect import DrawnEffect
from sim_gap.blind.motion import KINDS, MotionLimits, trajectory
from sim_gap.blind.scene import Scene, ServoLaw

ATTEMPTS = 600
"""Number of arms drawn for a case before it is left out; backlash, the rarest, takes some hundred."""
OTHER_PAIR = 20
"""Number of arms drawn for two effects before two others are drawn."""
NONE_SHARE, TWO_SHARE = 0.12, 0.18
"""Shares of the cases without an effect, and with two."""
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
REWRITING = {f"transmission.{name}" for name in ("coupling", "elasticity", "backlash")}
REWRITING |= {"friction.stribeck", "friction.asymmetric"}
"""Effects that are not drawn together with another one at one joint."""


@dataclass(frozen=True)
class CaseRecipe:
    """One case before it is drawn: its effects by id; or the number of effects of a `several` case."""

    name: str
    effects: tuple[str, ...]
    seed: tuple[int, int]
    several: int = 0
    """Number of effects that are drawn for the arm, whichever it can show; 0 if `effects` names them."""
    controller_known: bool | None = None
    """Of an arm with servos, of which positions alone are seen: whether the model has position actuators."""

    @property
    def servos(self) -> bool:
        return self.controller_known is not None

    @property
    def kind(self) -> str:
        """`none`, `single`, `two` or `several`."""
        return "several" if self.several else ("none", "single", "two")[len(self.effects)]


@dataclass(frozen=True)
class CaseDrawing:
    """One case drawn: the nominal arm along its training motion, its effects, and the motion that is held out."""

    recipe: CaseRecipe
    scene: Scene
    drawn: tuple[DrawnEffect, ...]
    motions: dict[str, tuple[str, ...]]
    heldout: Array
    """Command at `motion.RATE`, (K, n) [rad]."""
    attempt: int
    """Number of this drawing of the recipe."""
    random: np.random.Generator
    """Source of everything else that is drawn for the case."""


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


def servo_recipes(seed: int, count: int) -> list[CaseRecipe]:
    """`count` cases of positions alone, every effect in turn; the model of three in ten has no controller."""
    random = np.random.default_rng([seed, 7])
    known = random.random(count) > 0.3
    none = random.permutation(count) < round(NONE_SHARE * count)
    every = [*controller.DRAWS, *controller.OF_THE_ARM]
    orders = {True: random.permutation(every).tolist(), False: random.permutation(controller.UNKNOWN).tolist()}
    out, turn = [], {True: 0, False: 0}
    for k, (kind, nothing) in enumerate(zip(known.tolist(), none.tolist(), strict=True)):
        effects = () if nothing else (orders[kind][turn[kind] % len(orders[kind])],)
        turn[kind] += len(effects)
        out.append(CaseRecipe(f"case_{k:04d}", effects, (seed, k + 1), controller_known=kind))
    return out


def draw(recipe: CaseRecipe, train_s: float, heldout_s: float, first: int = 0) -> CaseDrawing | None:
    """Draw one case; arms that cannot show its effects are drawn again, None if there is none in `ATTEMPTS`.

    `first` is the number of the first attempt.
    """
    for attempt in range(first, first + ATTEMPTS):
        random = np.random.default_rng([*recipe.seed, attempt])
        if recipe.kind == "two" and attempt >= OTHER_PAIR:
            recipe = replace(recipe, effects=_pair(np.random.default_rng([*recipe.seed, attempt // OTHER_PAIR])))
        arm = draw_arm(random, int(random.integers(2, 4)) if recipe.servos else None)
        limits = _limits(arm, recipe.servos, random)
        held = str(random.choice(KINDS))
        others = [kind for kind in KINDS if kind != held]
        training = tuple(others if recipe.servos or random.random() < 0.6 else [str(random.choice(others))])
        training += ("chirp",) * bool(random.random() < 0.5)
        scene = Scene(arm, trajectory(training, train_s, limits, random))
        if recipe.servos:
            omega, none = 2 * np.pi * random.uniform(2.5, 5.0, arm.n), np.zeros((3, arm.n))
            damping = 2.0 * random.uniform(0.7, 1.1) * scene.inertia * omega
            unlimited = np.full(arm.n, np.inf)
            scene.law = ServoLaw(scene.inertia * omega**2, damping, none[0], none[1], unlimited, none[2])
        drawn = _several(recipe.several, scene, random) if recipe.several else _named(recipe.effects, scene, random)
        if drawn is None:
            continue
        for effect in drawn:
            arm = effect.nominal(arm)
        command = trajectory((held,), heldout_s, limits, random)
        scene, motions = Scene(arm, scene.command, scene.law), {"train": training, "heldout": (held,)}
        return CaseDrawing(recipe, scene, drawn, motions, command, attempt, random)
    return None


def _named(effects: tuple[str, ...], scene: Scene, random: np.random.Generator) -> tuple[DrawnEffect, ...] | None:
    """These effects on one arm; None if it cannot show one of them or they exclude each other."""
    drawn = [{**DRAWS, **controller.DRAWS}[effect](scene, random) for effect in effects]
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


def _limits(arm: BenchArm, servos: bool, random: np.random.Generator) -> MotionLimits:
    if servos:
        velocity = np.linspace(random.uniform(1.0, 1.8), random.uniform(2.0, 3.0), arm.n)
        return MotionLimits(arm.lower, arm.upper, velocity, 4.0 * velocity)
    velocity = np.linspace(random.uniform(0.8, 1.3), random.uniform(1.5, 2.6), arm.n)
    acceleration = np.linspace(random.uniform(2.5, 4.0), random.uniform(6.0, 10.0), arm.n)
    return MotionLimits(arm.lower, arm.upper, velocity, acceleration)


def _compatible(first: DrawnEffect, second: DrawnEffect) -> bool:
    """Whether two effects can be combined: on a common joint, neither may overwrite the other."""
    return not (set(first.joints) & set(second.joints) and {first.effect, second.effect} & REWRITING)


def _distinct(first: DrawnEffect, second: DrawnEffect, tip: str) -> bool:
    """Whether slow motion can separate two effects of one arm: a payload counts as one of the last joint, a tilt as one
    of any."""
    effects = {first.effect, second.effect}
    places = [{tip} if each.effect == "link.payload" else set(each.joints) for each in (first, second)]
    return effects not in INDISTINCT or not ("base.tilt" in effects or places[0] & places[1])
