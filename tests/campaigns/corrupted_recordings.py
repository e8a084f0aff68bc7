"""Draws faults of mapping, units and clocks into recordings of real arms: named, corrected or refused, never silent.

    python tests/campaigns/corrupted_recordings.py --draws 200 [--realdata DIR]

One line a draw, then what was noticed by kind; the recordings as they are must be no finding. Exit status 1 below 98 %
of the draws that can be told. Which can is judged apart from the check, by MuJoCo's inverse dynamics: a draw changes
nothing that the recording could tell if the nominal model fits the spoiled recording as well as the sound one, to 5 %.
So it is with the zero of a last joint on whose axis its mass lies, or with two wrist joints of which friction is all
that is read.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from scipy.optimize import nnls
from scipy.signal import lfilter, savgol_filter

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS
from armlink.recording.files import load_recording
from armlink.recording.recording import TORQUE_CHANNELS, Recording, take_joints
from sim_gap.checks.check import check_recording
from sim_gap.model.load import load_model

ARMS = (("ur10e", "train_a"), ("tx40", "recording"), ("ur10", "recording"), ("panda", "recording"), ("lwr4", "train"))
GOAL = 0.98
AS_WELL = 0.05
"""Most by which the model may fit a spoiled recording worse, logarithm of RMS, for it to fit as well: masses that are
off by a few per cent do as much."""
Corruption = Callable[[Recording, np.random.Generator], Recording | None]


def torque_channel(recording: Recording) -> str:
    return "torque" if recording.torque is not None else "motor_torque"


def with_torque(recording: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    name = torque_channel(recording)
    return replace(recording, **{name: change(getattr(recording, name).copy())})


def one_sign(recording: Recording, random: np.random.Generator) -> Recording:
    sign = np.ones(recording.n)
    sign[random.integers(recording.n)] = -1.0
    return with_torque(recording, lambda y: y * sign)


def position_sign(recording: Recording, random: np.random.Generator) -> Recording:
    sign = np.ones(recording.n)
    sign[random.integers(recording.n)] = -1.0
    velocity = None if recording.velocity is None else recording.velocity * sign
    return replace(recording, position=recording.position * sign, velocity=velocity)


def degrees(recording: Recording, _: np.random.Generator) -> Recording:
    velocity = None if recording.velocity is None else np.degrees(recording.velocity)
    return replace(recording, position=np.degrees(recording.position), velocity=velocity)


def amperes(recording: Recording, random: np.random.Generator) -> Recording:
    constants = (
        random.uniform(8.0, 20.0, recording.n) if random.random() < 0.5 else random.uniform(0.02, 0.3, recording.n)
    )
    return with_torque(recording, lambda y: y / constants)


def exchanged(recording: Recording, random: np.random.Generator) -> Recording:
    i, k = random.choice(recording.n, 2, replace=False)
    order = np.arange(recording.n)
    order[[i, k]] = order[[k, i]]
    return take_joints(recording, order.tolist(), recording.names)


def exchanged_torque(recording: Recording, random: np.random.Generator) -> Recording:
    i, k = random.choice(recording.n, 2, replace=False)
    order = np.arange(recording.n)
    order[[i, k]] = order[[k, i]]
    return with_torque(recording, lambda y: y[:, order])


def reversed_order(recording: Recording, _: np.random.Generator) -> Recording:
    return take_joints(recording, list(reversed(range(recording.n))), recording.names)


def zero(recording: Recording, random: np.random.Generator) -> Recording:
    position = recording.position.copy()
    position[:, random.integers(1, recording.n)] += random.choice([0.5 * np.pi, -0.5 * np.pi, np.pi])
    return replace(recording, position=position)


def effort(recording: Recording, _: np.random.Generator) -> Recording | None:
    return (
        None if recording.motor_torque is None else replace(recording, torque=recording.motor_torque, motor_torque=None)
    )


def skew(recording: Recording, random: np.random.Generator) -> Recording:
    late = random.choice([-1.0, 1.0]) * random.uniform(0.2, 1.0)
    return with_torque(
        recording, lambda y: np.column_stack([np.interp(recording.t - late, recording.t, x) for x in y.T])
    )


def jitter(recording: Recording, random: np.random.Generator) -> Recording:
    period = float(np.median(np.diff(recording.t)))
    received = np.maximum.accumulate(recording.t + np.abs(random.normal(0.0, 0.6 * period, recording.t.size)))
    return replace(recording, t=received + 1e-9 * np.arange(recording.t.size))


def repeats(recording: Recording, random: np.random.Generator) -> Recording:
    rows = np.arange(recording.t.size)
    rows[1:] -= random.random(rows.size - 1) < 0.15
    return replace(recording, **{name: values[rows] for name, values in recording.channels().items()})


def dropped(recording: Recording, random: np.random.Generator) -> Recording:
    kept = random.random(recording.t.size) > 0.3
    return replace(
        recording, **{name: values[kept] for name, values in recording.channels().items()}, t=recording.t[kept]
    )


def counts(recording: Recording, random: np.random.Generator) -> Recording:
    per_rad = random.choice([1024, 4096, 16384, 2**17, 2**20]) / (2.0 * np.pi)
    velocity = None if recording.velocity is None else recording.velocity * per_rad
    return replace(recording, position=np.round(recording.position * per_rad), velocity=velocity)


def velocity_filtered(recording: Recording, random: np.random.Generator) -> Recording | None:
    if recording.velocity is None:
        return None
    slow = 1.0 - np.exp(-np.median(np.diff(recording.t)) / random.uniform(0.1, 0.4))
    return replace(recording, velocity=lfilter([slow], [1.0, slow - 1.0], recording.velocity, axis=0))


def velocity_degrees(recording: Recording, _: np.random.Generator) -> Recording | None:
    return None if recording.velocity is None else replace(recording, velocity=np.degrees(recording.velocity))


def velocity_order(recording: Recording, _: np.random.Generator) -> Recording | None:
    return None if recording.velocity is None else replace(recording, velocity=recording.velocity[:, ::-1])


CORRUPTIONS: dict[str, Corruption] = {
    "sign of one torque": one_sign,
    "sign of all torques": lambda recording, _: with_torque(recording, lambda y: -y),
    "sign of a position": position_sign,
    "degrees": degrees,
    "amperes": amperes,
    "unsigned": lambda recording, _: with_torque(recording, np.abs),
    "joints exchanged": exchanged,
    "torques exchanged": exchanged_torque,
    "reverse order": reversed_order,
    "zero": zero,
    "effort": effort,
    "skew": skew,
    "jitter": jitter,
    "repeats": repeats,
    "dropped": dropped,
    "encoder counts": counts,
    "velocity filtered": velocity_filtered,
    "velocity in degrees": velocity_degrees,
    "velocity order": velocity_order,
}


def said(arm, recording: Recording) -> str:
    try:
        return "; ".join(f"{each.finding} {each.option}" for each in check_recording(arm, recording, "r", AS_IT_IS)[1])
    except BadInput as error:
        return f"refused: {error}"


def as_recorded(realdata: Path):
    """Name, nominal arm and recording of every real recording with torque."""
    for path in sorted(realdata.glob("*/*.csv.gz")):
        recording, folder = load_recording(path), path.parent.name
        if all(getattr(recording, name) is None for name in TORQUE_CHANNELS):
            continue
        model = realdata / folder.removesuffix("_loads") / "sim.xml"
        if path.name.startswith("designc"):
            model = model.with_name("sim_design_c.xml")
        yield f"{folder}/{path.name}", load_model(model, (), recording.n).arm, recording


def left_by_mujoco(model: mujoco.MjModel, recording: Recording) -> np.ndarray:
    """What the nominal model leaves of each joint's torque at best, (K, n) [N·m], 25 rows a second.

    MuJoCo's inverse dynamics along the smoothed positions, with a gain, an offset, friction and a rotor of each joint
    that are fitted: gains not negative, nor friction and rotors where a motor feels them.
    """
    t = np.arange(recording.t[0], recording.t[-1], 0.01)
    q, y = (
        np.column_stack([np.interp(t, recording.t, column) for column in values.T])
        for values in (recording.position, getattr(recording, torque_channel(recording)))
    )
    window = {"window_length": 31, "polyorder": 3, "axis": 0}
    q, v, a = (savgol_filter(q, deriv=order, delta=0.01, **window) for order in range(3))
    y = savgol_filter(y, **window)
    data, rows = mujoco.MjData(model), range(30, len(t) - 30, 4)
    torque = np.empty((len(rows), recording.n))
    for k, row in enumerate(rows):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], v[row], a[row]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse
    left = np.empty_like(torque)
    for j in range(recording.n):
        own = [np.tanh(v[rows, j] / 0.01), v[rows, j], a[rows, j]]
        both = own if recording.motor_torque is not None else [*own, *(-x for x in own)]
        columns = np.column_stack([torque[:, j], *both, np.ones(len(rows)), -np.ones(len(rows))])
        left[:, j] = y[rows, j] - columns @ nnls(columns, y[rows, j])[0]
    return left


def worse_by(model: mujoco.MjModel, sound: Recording, spoiled: Recording) -> float:
    """How much worse the nominal model fits the spoiled recording: logarithm of RMS, mean over the joints."""

    def size(recording: Recording) -> float:
        left = left_by_mujoco(model, recording)
        return float(np.mean(np.log(np.sqrt(np.mean(left**2, axis=0)) + 1e-6)))

    return size(spoiled) - size(sound)


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--draws", type=int, default=200)
    options.add_argument("--realdata", type=Path, default=Path(__file__).parents[3] / "shared" / "realdata")
    options.add_argument("--seed", type=int, default=1)
    asked = options.parse_args()
    arms = {}
    for folder, file in ARMS:
        recording = load_recording(asked.realdata / folder / f"{file}.csv.gz")
        arms[folder] = load_model(asked.realdata / folder / "sim.xml", (), recording.n).arm, recording
    alarms = {name: text for name, arm, recording in as_recorded(asked.realdata) if (text := said(arm, recording))}
    print("as recorded, all recordings with torque:", alarms or "no finding", flush=True)
    random, seen, noticed, unseen = np.random.default_rng(asked.seed), Counter(), Counter(), 0
    while seen.total() < asked.draws:
        kind = list(CORRUPTIONS)[random.integers(len(CORRUPTIONS))]
        folder = list(arms)[random.integers(len(arms))]
        arm, recording = arms[folder]
        spoiled = CORRUPTIONS[kind](recording, random)
        if spoiled is None:
            continue
        text = said(arm, spoiled)
        seen[kind] += 1
        noticed[kind] += bool(text)
        if not text:
            model = mujoco.MjModel.from_xml_path(str(asked.realdata / folder / "sim.xml"))
            worse = worse_by(model, recording, spoiled)
            unseen += worse <= AS_WELL
            text = f"NOTHING, {'cannot be told' if worse <= AS_WELL else 'MISSED'}: fits worse by {worse:.3f}"
        print(f"{kind:20s} {folder:6s} {text}"[:200], flush=True)
    for kind in seen:
        print(f"{kind:20s} {noticed[kind]} of {seen[kind]}")
    told = seen.total() - unseen
    share = noticed.total() / max(told, 1)
    print(f"noticed: {noticed.total()} of {seen.total()}; of the {told} that can be told {share:.1%}")
    return 0 if share >= GOAL and not alarms else 1


if __name__ == "__main__":
    sys.exit(main())
