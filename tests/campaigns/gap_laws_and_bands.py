"""Campaign: what lies at the edge of the library: breakaway, warm-up, hum and resonance, on a three-joint arm.

    python tests/campaigns/gap_laws_and_bands.py [--cases 20] [--seed 1] [--only hum]

Each case has Coulomb friction at every joint and one more thing at one joint: friction that breaks away, friction that
falls as the joint warms up (with or without a temperature channel), a hum, or a resonance that noise excites. It has to
be named or told as a law, or as a row of `where` with its frequency, never be `no_gap`, and never be another cause
above a confidence of 0.8. Exit status 1 if a case is not.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

sys.path.insert(0, str(Path(__file__).parent.parent / "sim_gap"))
from wrong_arms import Wrong, model, record

from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.attribution.diagnosis import Diagnosis

SECONDS, RATE, SURE = 60.0, 250.0, 0.8
CHANNELS = ("tau", "tau_motor")


@dataclass(frozen=True)
class Case:
    """One thing that is wrong, beside friction."""

    what: str
    joint: int
    make: Callable[[int], Recording]
    """A recording from a seed."""
    told: Callable[[Diagnosis], bool]
    own: tuple[str, ...] = ()
    """Effects that it may be called, beside Coulomb friction."""


def breakaway(random: np.random.Generator) -> Case:
    """Friction that is 2 to 3.5 times the Coulomb friction where the joint starts to move."""
    joint, coulomb = int(random.integers(3)), random.uniform(0.3, 0.8, 3)
    more, speed = np.zeros(3), float(random.uniform(0.02, 0.1))
    more[joint] = coulomb[joint] * random.uniform(1.0, 2.5)
    wrong = Wrong(coulomb=coulomb, breakaway=more, stribeck_velocity=speed)

    def told(answer: Diagnosis) -> bool:
        every = (*answer.causes, *answer.minor)
        named = any(c.effect == "friction.stribeck" and _name(joint) in c.joints for c in every)
        return named or _law(answer, joint, "velocity") or _place(answer, joint, ("rest", "creep"))

    what = f"{coulomb[joint]:.2f} + {more[joint]:.2f} N·m below {speed:.3f} rad/s"
    return Case(what, joint, lambda seed: _recorded(wrong, seed), told, ("friction.stribeck", "friction.asymmetric"))


def warm_up(random: np.random.Generator) -> Case:
    """Friction that falls from 2.0 towards 1.2 N·m, say, over ten seconds to a minute."""
    joint, coulomb = int(random.integers(3)), random.uniform(0.3, 1.2, 3)
    fall, time, warm = float(random.uniform(0.5, 1.2)), float(random.uniform(10.0, 60.0)), random.random() < 0.5

    def make(seed: int) -> Recording:
        made = _recorded(Wrong(coulomb=coulomb), seed)
        assert made.motor_torque is not None
        motor, cooling = made.motor_torque.copy(), np.exp(-made.t / time)
        motor[:, joint] += fall * cooling * np.tanh(np.gradient(made.position[:, joint], made.t) / 0.002)
        heat = np.full(made.position.shape, 25.0)
        heat[:, joint] += 15.0 * (1.0 - cooling)
        return replace(made, motor_torque=motor, temperature=heat if warm else None)

    def told(answer: Diagnosis) -> bool:
        return any(_law(answer, joint, quantity) for quantity in ("time", "temperature"))

    return Case(f"{fall:.2f} N·m over {time:.0f} s{', temperature' * warm}", joint, make, told)


def hum(random: np.random.Generator) -> Case:
    """A sine in one torque channel of one joint, at 7 to 100 Hz."""
    joint, channel = int(random.integers(3)), str(random.choice(CHANNELS))
    size, hertz = float(random.uniform(0.2, 1.0)), float(random.uniform(7.0, 100.0))

    def make(seed: int) -> Recording:
        made = _recorded(Wrong(coulomb=0.3), seed)
        return _added(made, joint, (channel,), size * np.sin(2.0 * np.pi * hertz * made.t + 0.3))

    return Case(
        f"{size:.2f} N·m at {hertz:.1f} Hz in {channel}",
        joint,
        make,
        lambda a: _line(a, joint, hertz, 0.02, (channel,)),
    )


def resonance(random: np.random.Generator) -> Case:
    """A lightly damped mode of one joint, excited by noise, in both torque channels."""
    joint, hertz = int(random.integers(3)), float(random.uniform(8.0, 40.0))
    damping, size = float(random.uniform(0.01, 0.05)), float(random.uniform(0.2, 0.8))

    def make(seed: int) -> Recording:
        made = _recorded(Wrong(coulomb=0.3), seed)
        pole = np.exp((-damping + 1j * np.sqrt(1.0 - damping**2)) * 2.0 * np.pi * hertz / RATE)
        noise = np.random.default_rng(seed + 7).normal(size=len(made.t))
        ring = np.asarray(lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], noise))
        return _added(made, joint, CHANNELS, size * ring / ring.std())

    return Case(
        f"{size:.2f} N·m at {hertz:.1f} Hz, damping {damping:.3f}", joint, make, lambda a: _line(a, joint, hertz, 0.1)
    )


def _recorded(wrong: Wrong, seed: int) -> Recording:
    return record(model(), wrong, seed, seconds=SECONDS, rate=RATE)


def _added(made: Recording, joint: int, channels: tuple[str, ...], more: np.ndarray) -> Recording:
    """The recording with a torque added to one joint's channels."""
    assert made.torque is not None
    assert made.motor_torque is not None
    both = {"tau": made.torque.copy(), "tau_motor": made.motor_torque.copy()}
    for channel in channels:
        both[channel][:, joint] += more
    return replace(made, torque=both["tau"], motor_torque=both["tau_motor"])


def _name(joint: int) -> str:
    return f"joint_{joint + 1}"


def _law(answer: Diagnosis, joint: int, quantity: str) -> bool:
    return any(law.joint == joint and law.quantity == quantity for law in answer.laws)


def _place(answer: Diagnosis, joint: int, regimes: tuple[str, ...]) -> bool:
    return any(place.joint == _name(joint) and place.regime in regimes and place.clear for place in answer.where)


def _line(answer: Diagnosis, joint: int, hertz: float, share: float, channels: tuple[str, ...] = CHANNELS) -> bool:
    lines = [p for p in answer.where if p.regime == "band" and p.joint == _name(joint) and p.channel in channels]
    return any(abs(line.hz / hertz - 1.0) < share for line in lines)


def run(kind: Callable[[np.random.Generator], Case], random: np.random.Generator) -> tuple[bool, str]:
    """One case: whether it is told, and a line."""
    case = kind(random)
    fit, other = (case.make(int(random.integers(2**31))) for _ in range(2))
    answer = diagnose(model(), [fit], [other])
    own = ("friction.coulomb", *case.own)
    false = [f"{c.effect} {c.confidence:.2f}" for c in answer.causes if c.confidence > SURE and c.effect not in own]
    told = case.told(answer)
    good = told and answer.verdict != "no_gap" and not false
    said = [f"{cause.effect} {cause.confidence:.2f}" for cause in answer.causes]
    said += [f"law.{law.quantity} {_name(law.joint)}" for law in answer.laws]
    said += [f"{p.regime} {p.joint}" for p in answer.where if p.clear]
    return good, (
        f"{kind.__name__} {_name(case.joint)}, {case.what}: {answer.verdict}, "
        f"{'told' if told else 'NOT told'}, false {false}; {said}"
    )


KINDS = (breakaway, warm_up, hum, resonance)


def main() -> int:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=[kind.__name__ for kind in KINDS])
    given = parser.parse_args()
    wrong = 0
    for place, kind in enumerate(KINDS):
        if given.only not in (None, kind.__name__):
            continue
        bad = 0
        for number in range(given.cases):
            good, line = run(kind, np.random.default_rng([given.seed, place, number]))
            bad += not good
            print(f"{'ok ' if good else 'NOT'} {line}", flush=True)
        print(f"{kind.__name__}: {given.cases - bad} of {given.cases}", flush=True)
        wrong += bad
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
