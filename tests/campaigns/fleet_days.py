"""Twenty simulated arms over sixty days, five of which wear: each seen before half of it, no alarm on the others.

    python tests/campaigns/fleet_days.py [--arms 20] [--days 60] [--seed 1]

Every arm is recorded once a day on the same motion and diagnosed; friction, play or the gain of a sensor of the worn
arms changes from a quarter of the days on, over 60 % of them. Prints the changes found; exit status 1 if one is noticed
late (after half of it), or another is.
"""

import argparse
import json
import sys
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "sim_gap"))
from wrong_arms import Wrong, model, record

from sim_gap.attribution.diagnose import diagnose
from sim_gap.trends import Trend, fleet_trends, watched_parameters

START = date(2026, 9, 1)
FRICTION, GAIN, PLAY = 0.30, -0.03, np.radians(0.2)
"""Relative change of the friction and of the gain of a joint by wear, and its play by then [rad]."""
NOISE = 0.02
"""Of both torque channels [N·m]."""
WORN = (
    ("friction.coulomb", 1),
    ("torque.gain", 1),
    ("transmission.backlash", 0),
    ("friction.viscous", 2),
    ("transmission.backlash", 1),
)
"""Effect and joint of each worn arm."""


def of_the_day(effect: str, joint: int, worn: float, own: np.ndarray, random: np.random.Generator) -> Wrong:
    """An arm with its own friction and gain, which vary by a per cent from day to day."""
    daily = own * random.normal(1.0, 0.01, own.shape)
    gain, play = 1.1 * np.ones(3) * random.normal(1.0, 0.001, 3), np.zeros(3)
    if effect == "torque.gain":
        gain[joint] *= 1.0 + GAIN * worn
    elif effect == "transmission.backlash":
        play[joint] = PLAY * worn
    elif effect:
        daily[("friction.coulomb", "friction.viscous").index(effect), joint] *= 1.0 + FRICTION * worn
    return Wrong(coulomb=daily[0], viscous=daily[1], gain=gain, play=play)


def kept_answers(path: Path | None) -> dict[str, dict]:
    """Answers of an earlier run that was ended, by case."""
    if path is None or not path.exists():
        return {}
    return {line["case"]: line["answer"] for line in map(json.loads, path.read_text().splitlines())}


def told_day_by_day(answers: dict[str, dict], days: int) -> dict[tuple[str, ...], tuple[date, Trend]]:
    """The first day on which each change is told, from the answers up to that day, and how it is told then."""
    found: dict[tuple[str, ...], tuple[date, Trend]] = {}
    for today in (START + timedelta(days=day) for day in range(days)):
        for trend in fleet_trends({case: each for case, each in answers.items() if case[-10:] <= today.isoformat()}):
            found.setdefault((trend.arm, trend.effect, trend.joint, trend.parameter), (today, trend))
    return found


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--arms", type=int, default=20)
    options.add_argument("--days", type=int, default=60)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument(
        "--answers", type=Path, help="keep the answers here, one JSON line each; those there are not repeated"
    )
    asked = options.parse_args()
    answers = kept_answers(asked.answers)
    begins, takes = asked.days // 4, int(0.6 * asked.days)
    wears = {f"arm_{4 * k % asked.arms:02d}": WORN[k] for k in range(min(5, max(1, asked.arms // 4)))}
    for number in sorted(range(asked.arms), key=lambda number: f"arm_{number:02d}" not in wears):
        arm = f"arm_{number:02d}"
        random = np.random.default_rng((asked.seed, number))
        own = np.array([[1.2], [0.8]]) * random.uniform(0.8, 1.2, (2, 3))
        effect, joint = wears.get(arm, ("", 0))
        for day in range(asked.days):
            worn = float(np.clip((day - begins) / takes, 0.0, 1.0))
            wrong = of_the_day(effect, joint, worn, own, random)
            clean = record(model(), wrong, seed=7, seconds=20.0, rate=50.0, noise=0.0)
            noise = random.normal(0.0, NOISE, (2, *clean.position.shape))
            case = f"{arm}/{(START + timedelta(days=day)).isoformat()}"
            if case in answers:
                continue
            channels = {"torque": clean.torque + noise[0], "motor_torque": clean.motor_torque + noise[1]}
            recording = replace(clean, **channels)
            with patch("sim_gap.attribution.diagnose.roll_out", return_value=None):  # no trend needs it
                found = diagnose(model(), [recording])
            made = found.to_json() | {"watched": watched_parameters(found)}
            answers[case] = made
            if asked.answers:
                with asked.answers.open("a") as file:
                    file.write(json.dumps({"case": case, "answer": made}) + "\n")
        print(arm, effect or "sound", flush=True)
    half, right, false = START + timedelta(days=begins + takes // 2), set(), 0
    for (arm, effect, joint, parameter), (noticed, trend) in told_day_by_day(answers, asked.days).items():
        own = wears.get(arm) == (effect, int(joint[-1]) - 1)
        false += not own
        right |= {arm} if own and noticed < half else set()
        change = f"{trend.before:.4g} to {trend.now:.4g} {trend.unit} since {trend.since}"
        late = "" if noticed < half else "LATE"
        print(f"{noticed} {arm} {effect} {joint} {parameter} {change}", "" if own else "FALSE", late)
    print(f"half of the wear is on {half}, {len(answers)} diagnoses; ", end="")
    print(f"{len(right)} of {len(wears)} worn arms seen in time, {false} false alarms")
    return 0 if len(right) == len(wears) and not false else 1


if __name__ == "__main__":
    sys.exit(main())
