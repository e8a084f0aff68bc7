"""Twenty simulated arms over sixty days, five of which wear: each seen before half of it, no alarm on the others.

    python tests/campaigns/fleet_days.py [--arms 20] [--days 60] [--seed 1]

Every arm is recorded once a day on the same motion and diagnosed; friction or the gain of a sensor of the worn arms
changes from a quarter of the days on, over 60 % of them. Prints the changes found; exit status 1 if one is noticed late
(after half of it), or another is.
"""

import argparse
import sys
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "sim_gap"))
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.fleet.trends import fleet_trends

START = date(2026, 9, 1)
FRICTION, GAIN = 0.30, -0.03
"""Relative change of the friction and of the gain of a joint by wear."""
NOISE = 0.02
"""Of both torque channels [N·m]."""
WORN = (
    ("friction.coulomb", 1),
    ("torque.gain", 1),
    ("friction.coulomb", 0),
    ("friction.viscous", 2),
    ("torque.gain", 0),
)
"""Effect and joint of each worn arm."""


def of_the_day(effect: str, joint: int, worn: float, own: np.ndarray, random: np.random.Generator) -> Wrong:
    """An arm with its own friction and gain, which vary by a per cent from day to day."""
    daily = own * random.normal(1.0, 0.01, own.shape)
    gain = 1.1 * np.ones(3) * random.normal(1.0, 0.001, 3)
    if effect == "torque.gain":
        gain[joint] *= 1.0 + GAIN * worn
    elif effect:
        daily[("friction.coulomb", "friction.viscous").index(effect), joint] *= 1.0 + FRICTION * worn
    return Wrong(coulomb=daily[0], viscous=daily[1], gain=gain)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--arms", type=int, default=20)
    options.add_argument("--days", type=int, default=60)
    options.add_argument("--seed", type=int, default=1)
    asked = options.parse_args()
    random, answers = np.random.default_rng(asked.seed), {}
    begins, takes = asked.days // 4, int(0.6 * asked.days)
    wears = {f"arm_{4 * k % asked.arms:02d}": WORN[k] for k in range(min(5, max(1, asked.arms // 4)))}
    for number in range(asked.arms):
        arm = f"arm_{number:02d}"
        own = np.array([[1.2], [0.8]]) * random.uniform(0.8, 1.2, (2, 3))
        effect, joint = wears.get(arm, ("", 0))
        for day in range(asked.days):
            worn = float(np.clip((day - begins) / takes, 0.0, 1.0))
            wrong = of_the_day(effect, joint, worn, own, random)
            clean = record(model(), wrong, seed=7, seconds=20.0, rate=50.0, noise=0.0)
            noise = random.normal(0.0, NOISE, (2, *clean.position.shape))
            channels = {"torque": clean.torque + noise[0], "motor_torque": clean.motor_torque + noise[1]}
            recording = replace(clean, **channels)
            made = diagnose(model(), [recording]).to_json()
            answers[f"{arm}/{(START + timedelta(days=day)).isoformat()}"] = made
        print(arm, effect or "sound", flush=True)
    found, right = fleet_trends(answers), set()
    half = START + timedelta(days=begins + takes // 2)
    for trend in found:
        meant = wears.get(trend.arm)
        own = meant == (trend.effect, int(trend.joint[-1]) - 1)
        early = date.fromisoformat(trend.noticed) < half
        right |= {trend.arm} if own and early else set()
        print(trend, "" if own else "FALSE", "" if early else "LATE")
    false = [trend for trend in found if wears.get(trend.arm, ("", 0))[0] != trend.effect]
    print(f"{len(right)} of {len(wears)} worn arms seen in time, {len(false)} false alarms")
    return 0 if len(right) == len(wears) and not false else 1


if __name__ == "__main__":
    sys.exit(main())
