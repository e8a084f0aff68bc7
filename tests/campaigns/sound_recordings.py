"""Campaign: recordings of sound arms, drawn, of which the check must neither ask nor correct anything.

    python tests/campaigns/sound_recordings.py [--draws 300] [--seed 1]

Arms of one to seven joints with drawn axes, links and ratings; up to eight effects that real arms have; all joints
moving, one at a time, one way, or from pose to pose; torque of links, motors, commands or several of them, 30 to 500
rows a second. Torques come from MuJoCo's inverse dynamics along the true motion. Exit status 1 if there is a finding.
"""

import argparse
import sys
from collections.abc import Callable

import mujoco
import numpy as np

from armlink.errors import BadInput
from armlink.recording.corrections import AS_IT_IS
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import checked_recordings

Random = np.random.Generator
Motion = tuple[np.ndarray, np.ndarray, np.ndarray]


def links(random: Random, n: int) -> list[dict[str, np.ndarray | float]]:
    """A chain that tapers towards its tip: axis, length, mass, centre and inertia of each link."""
    mass, length = random.uniform(1.0, 12.0), random.uniform(0.15, 0.45)
    out, before = [], np.array([0.0, 0.0, 1.0])
    for _ in range(n):
        axis = np.eye(3)[random.integers(3)]
        if abs(axis @ before) > 0.5 and random.random() < 0.7:
            axis = np.roll(axis, 1)
        before = axis
        size = random.uniform(0.02, 0.08, 3)
        way = random.normal(size=3)
        way *= length / np.linalg.norm(way)
        inertia = mass / 3.0 * (np.sum(size**2) - size**2)
        centre = random.uniform(0.2, 0.7) * way + random.normal(0.0, 0.02, 3)
        out.append({"axis": axis, "way": way, "mass": mass, "centre": centre, "inertia": inertia})
        mass, length = mass * random.uniform(0.45, 0.95), length * random.uniform(0.6, 1.05)
    return out


def model(chain: list[dict], gravity: np.ndarray | None = None) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.gravity = [0.0, 0.0, -9.81] if gravity is None else gravity
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    body, at = spec.worldbody, np.array([0.0, 0.0, 0.3])
    for k, link in enumerate(chain):
        body = body.add_body(name=f"link_{k + 1}", pos=at, mass=link["mass"], ipos=link["centre"])
        body.inertia, body.explicitinertial = link["inertia"], True
        body.add_joint(name=f"joint_{k + 1}", axis=link["axis"], type=mujoco.mjtJoint.mjJNT_HINGE)
        at = link["way"]
    return spec.compile()


def sines(random: Random, t: np.ndarray, n: int, reach: np.ndarray) -> Motion:
    f, phase = random.uniform(0.04, 0.5, (3, n)), random.uniform(0.0, 2.0 * np.pi, (3, n))
    share = random.uniform(0.3, 1.0, (3, n))
    share /= share.sum(0)
    x = 2.0 * np.pi * f * t[:, None, None] + phase
    w = 2.0 * np.pi * f
    parts = reach * share * np.sin(x), reach * share * w * np.cos(x), -reach * share * w**2 * np.sin(x)
    q, v, a = (part.sum(1) for part in parts)
    return q + random.uniform(-0.8, 0.8, n), v, a


def minimum_jerk(t: np.ndarray, start: float, end: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    s, d = np.clip((t - start) / (end - start), 0.0, 1.0), end - start
    return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / d, 60 * s * (1 - s) * (1 - 2 * s) / d**2


def steps(random: Random, t: np.ndarray, n: int, reach: np.ndarray, one_way: bool, alone: int | None) -> Motion:
    """From pose to pose with rests between."""
    q, v, a = (np.zeros((len(t), n)) for _ in range(3))
    q += random.uniform(-0.8, 0.8, n)
    count, move = max(2, int(t[-1] / random.uniform(2.5, 5.0))), np.zeros(n)
    for k in range(count):
        start = k * t[-1] / count
        new = random.uniform(-1.0, 1.0, n) * reach
        move = np.abs(new) / count * 1.5 if one_way else new if k % 2 == 0 else -move
        if alone is not None:
            move = move * (np.arange(n) == alone)
        shapes = minimum_jerk(t, start + 0.3, start + 0.85 * t[-1] / count)
        for whole, shape in zip((q, v, a), shapes, strict=True):
            whole += shape[:, None] * move
    return q, v, a


def motion(random: Random, t: np.ndarray, n: int) -> tuple[str, Motion]:
    reach, kind = random.uniform(0.4, 1.3, n), random.choice(["sines", "sines", "poses", "alone", "alone", "one way"])
    if kind == "sines":
        return str(kind), sines(random, t, n, reach)
    alone = int(random.integers(n)) if kind == "alone" else None
    return str(kind), steps(random, t, n, reach, kind == "one way", alone)


def inverse(arm: mujoco.MjModel, way: Motion) -> np.ndarray:
    data, out = mujoco.MjData(arm), np.empty_like(way[0])
    for k, (q, v, a) in enumerate(zip(*way, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(arm, data)
        out[k] = data.qfrc_inverse
    return out


def scale_of(torque: np.ndarray) -> np.ndarray:
    """Usual torque of each joint; a small share of the largest where gravity hardly loads one."""
    usual = np.sqrt(np.mean(torque**2, axis=0))
    return np.maximum(usual, 0.05 * usual.max())


Change = Callable[[Random, np.ndarray, Motion, np.ndarray], np.ndarray]


def on_one(change: Change) -> Change:
    def at_one(random: Random, torque: np.ndarray, way: Motion, usual: np.ndarray) -> np.ndarray:
        joint = int(random.integers(torque.shape[1]))
        out = torque.copy()
        out[:, joint] = change(random, torque, way, usual)[:, joint]
        return out

    return at_one


DRIVES: dict[str, Change] = {
    "viscous": lambda r, x, w, s: x + r.uniform(0.02, 0.3, len(s)) * s * w[1],
    "load friction": on_one(lambda r, x, w, s: x + r.uniform(0.03, 0.15) * np.abs(x) * np.tanh(w[1] / 0.01)),
    "rotor": lambda r, x, w, s: x + r.uniform(0.002, 0.03, len(s)) * s * w[2],
    "ripple": on_one(lambda r, x, w, s: x + r.uniform(0.02, 0.1) * s * np.sin(r.integers(2, 60) * w[0])),
    "motor gain": on_one(lambda r, x, w, s: x * r.uniform(0.8, 1.25)),
}
EITHER: dict[str, Change] = {
    "spring": on_one(lambda r, x, w, s: x + r.uniform(0.1, 0.8) * s * (w[0] - r.uniform(-1.0, 1.0))),
    "counterbalance": on_one(lambda r, x, w, s: x - r.uniform(0.3, 1.0) * s * np.sin(w[0] + r.uniform(0.0, 6.3))),
    "gain": on_one(lambda r, x, w, s: x * r.uniform(0.85, 1.18)),
    "offset": lambda r, x, w, s: x + r.normal(0.0, 0.05, len(s)) * s,
    "drift": on_one(lambda r, x, w, s: x + np.linspace(0.0, r.uniform(-0.1, 0.1), len(x))[:, None] * s),
}


def draw(random: Random) -> tuple[str, mujoco.MjModel, Recording]:
    """A sound arm's nominal model and recording, and what is in it."""
    n, rate, seconds = (
        int(random.integers(1, 8)),
        float(random.choice([30, 50, 100, 125, 250, 500])),
        random.uniform(6, 40),
    )
    chain = links(random, n)
    real = [dict(link) for link in chain]
    told = []
    if random.random() < 0.5:
        share = random.choice([-1.0, 1.0]) * random.uniform(0.1, 0.5)
        real[-1]["mass"] *= 1.0 + share
        real[-1]["centre"] = real[-1]["centre"] * (1.0 + random.uniform(0.0, 0.6) * np.sign(share))
        told.append("gripper")
    if random.random() < 0.5:
        for link in real:
            link["mass"] *= 1.0 + random.normal(0.0, 0.06)
            link["centre"] = link["centre"] + random.normal(0.0, 0.006, 3)
        told.append("masses")
    t = np.arange(0.0, seconds, 1.0 / rate)
    kind, way = motion(random, t, n)
    link = inverse(model(real), way)
    usual = scale_of(link)
    for name in random.permutation([*EITHER])[: random.integers(0, 4)]:
        link = EITHER[name](random, link, way, usual)
        told.append(str(name))
    motor = link + random.uniform(0.02, 0.25, n) * usual * np.tanh(way[1] / 0.01)
    for name in random.permutation([*DRIVES])[: random.integers(0, 4)]:
        motor = DRIVES[name](random, motor, way, usual)
        told.append(str(name))
    channels, noise = {}, random.uniform(0.001, 0.02) * usual
    having = random.choice(["tau", "tau_motor", "tau_motor", "tau tau_motor", "tau_cmd", "tau_motor tau_cmd"]).split()
    for name, torque in (("tau", link), ("tau_motor", motor), ("tau_cmd", motor)):
        if name in having:
            read = torque + random.normal(size=torque.shape) * noise
            channels[{"tau": "torque", "tau_motor": "motor_torque", "tau_cmd": "torque_command"}[name]] = read
    position = way[0] + random.normal(0.0, 10 ** random.uniform(-5.5, -4.0), way[0].shape)
    velocity = way[1] + random.normal(0.0, 0.003, way[1].shape) if random.random() < 0.5 else None
    names = tuple(f"joint_{k + 1}" for k in range(n))
    made = Recording(t=t, position=position, velocity=velocity, names=names, **channels)
    return (
        f"{n} joints, {kind}, {'+'.join(having)}, {rate:g} Hz, {seconds:.0f} s, {', '.join(told)}",
        model(chain),
        made,
    )


def main() -> int:
    """Check all draws."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    given, wrong = parser.parse_args(), 0
    for number in range(given.draws):
        told, nominal, made = draw(np.random.default_rng([given.seed, number]))
        try:
            _, _, found = checked_recordings(nominal, [made], ["r"], AS_IT_IS, None, None)
            said = [f"{each.finding} of {each.channel} {each.joint}: {each.option}" for each in found]
        except BadInput as error:
            said = [f"refused: {error}"]
        wrong += bool(said)
        if said:
            print(f"NOT {number} {told}: {'; '.join(said)}", flush=True)
    print(f"{given.draws - wrong} of {given.draws} without a finding")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
