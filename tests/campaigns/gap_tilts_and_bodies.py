"""Campaign: bases turned by any angle, and bodies that some recordings have or lack, on a three-joint arm.

    python tests/campaigns/gap_tilts_and_bodies.py [--tilts 40] [--bodies 40] [--seed 1]

Tilts are drawn from 5 to 180 degrees: the angle has to come out within 0.5 degrees, and no other cause above a
confidence of 0.5. Bodies are drawn for any subset of two to four recordings and a held-out one, added to the flange or
missing from it: the mass has to come out within 5 %, in the right recordings. Exit status 1 if a bound is not met.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "sim_gap"))
from wrong_arms import THREE, Wrong, record

from armlink.recording.recording import Recording
from sim_gap.attribution.bodies import recordings_with
from sim_gap.attribution.diagnose import diagnose
from sim_gap.effects.link import tilt_gravity

ANGLE_DEG, OTHERS, MASS = 0.5, 0.5, 0.05
SECONDS, RATE = 30.0, 50.0
TIP = "</body></body></body>"


def tilt(random: np.random.Generator) -> tuple[bool, str]:
    """One turned base: whether it came out, and a line."""
    angle, heading = np.radians(random.uniform(5.0, 180.0)), random.uniform(0.0, 2.0 * np.pi)
    wanted = angle * np.array([np.cos(heading), np.sin(heading)])
    real = mujoco.MjModel.from_xml_string(THREE)
    real.opt.gravity[:] = tilt_gravity(np.array([0.0, 0.0, -9.81]), wanted)
    fit, other = (recorded(real, Wrong(coulomb=np.full(3, 0.3)), int(random.integers(2**31))) for _ in range(2))
    answer = diagnose(mujoco.MjModel.from_xml_string(THREE), [fit], [other])
    found = [cause for cause in answer.causes if cause.effect == "base.tilt"]
    values = found[0].parameters["arm"] if found else {}
    turned = np.array([values[name].value for name in ("angle_1", "angle_2")]) if found else np.zeros(2)
    down = [tilt_gravity(np.array([0.0, 0.0, -9.81]), each) for each in (turned, wanted)]
    error = float(np.degrees(np.arccos(np.clip(down[0] @ down[1] / 9.81**2, -1.0, 1.0))))
    false = [c.effect for c in answer.causes if c.confidence > OTHERS and c.effect not in ("base.tilt", FRICTION)]
    good = bool(found) and error < ANGLE_DEG and not false
    return good, f"tilt {np.degrees(angle):.1f}: off by {error:.2f} degrees, {answer.verdict}, false {false}"


FRICTION = "friction.coulomb"


def body(random: np.random.Generator) -> tuple[bool, str]:
    """One body, added or missing: whether mass and recordings came out, and a line."""
    count, mass = int(random.integers(2, 5)), float(random.uniform(0.4, 1.5))
    missing = bool(random.random() < 0.5)
    has = np.zeros(count + 1, bool)
    while has[:count].all() or not has[:count].any():
        has = random.random(count + 1) < 0.5
    at = np.round(random.uniform((-0.05, -0.05, 0.05), (0.05, 0.05, 0.2)), 3)
    tool = (
        f'<body pos="{at[0]} {at[1]} {at[2]}"><inertial pos="0 0 0" mass="{mass}" diaginertia="1e-6 1e-6 1e-6"/></body>'
    )
    nominal = THREE.replace(TIP, tool + TIP) if missing else THREE
    real = mujoco.MjModel.from_xml_string(THREE)
    wrong = [Wrong(coulomb=np.full(3, 0.3), payload=mass if there else 0.0, payload_at=tuple(at)) for there in has]
    made = [recorded(real, each, int(random.integers(2**31))) for each in wrong]
    labels = [f"recording {k + 1}" for k in range(count + 1)]
    answer = diagnose(mujoco.MjModel.from_xml_string(nominal), made[:count], made[count:], labels=labels)
    found = [cause for cause in answer.causes if cause.effect == "link.payload"]
    value = found[0].parameters["arm"]["mass"].value if found else 0.0
    sets = (answer.internals.train, answer.internals.heldout)
    terms = [term for term in answer.internals.estimate.terms if term.effect == "link.payload"]
    told = recordings_with(terms[0], sets) if terms else ()
    right = tuple(label for label, there in zip(labels, has, strict=True) if there != missing)
    signed = -mass if missing else mass
    good = bool(found) and abs(value - signed) < MASS * mass and told == right
    return good, f"body {signed:.3f} kg in {len(right)} of {count + 1}: {value:.3f}, {answer.verdict}, {told == right}"


def recorded(real: mujoco.MjModel, wrong: Wrong, seed: int) -> Recording:
    """Half a minute of an arm."""
    return record(real, wrong, seed, seconds=SECONDS, rate=RATE)


def main() -> int:
    """Run all draws."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--tilts", type=int, default=40)
    parser.add_argument("--bodies", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    kinds: tuple[tuple[Callable[[np.random.Generator], tuple[bool, str]], int], ...] = (
        (tilt, given.tilts),
        (body, given.bodies),
    )
    wrong = 0
    for kind, (draw, count) in enumerate(kinds):
        for number in range(count):
            good, line = draw(np.random.default_rng([given.seed, kind, number]))
            wrong += not good
            print(f"{'ok ' if good else 'NOT'} {line}", flush=True)
    print(f"{given.tilts + given.bodies - wrong} of {given.tilts + given.bodies} within bounds")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
