"""Arms with position servos that press on a table, and arms that do not: which are told apart, and at what moments?

    python tests/campaigns/pressed_arms.py [--seeds 1 2 3] [--cases 60]

The sealed cases of positions alone are made anew: arms of two and three joints with none or one effect of the library
that is not in their models. None of them touches anything. Then the nominal arm of each follows its training commands
in MuJoCo above a table, at a height below which the tip is commanded for 4 to 12 % of the time.

Printed are the number of cases in which a surface is found although there is none, and of those with a table: how many
are found, the share of the moments of contact that is left out for it, and of the moments left out, those that are
further than half a second from any contact. Exit status 1 if a surface is found in more than 1 % of the cases without
one, or in less than 80 % of those in which two joints or more lift the tip, the second by a quarter of what the first
does, and the table moves them by 0.02 to 0.5 rad (by more an arm has slipped aside), for two seconds or more.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import maximum_filter1d

from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.blind.cases import make_cases
from sim_gap.model.load import load_model
from sim_gap.position_gap.surface import find_surface

FALSE, FOUND, CLEAR_RAD, LIFTS, LONG_S = 0.01, 0.8, (0.02, 0.5), 0.25, 2.0
TIP = 1.5
"""Place of the tip in the last link, from its origin through its centre of mass."""


def above_a_table(path: Path, recording: Recording, share: float) -> tuple[Recording, np.ndarray, bool] | None:
    """The arm of a model along recorded commands above a table, the rows of contact, and whether two joints show it
    clearly; None if it touches nothing, or for a model without servos."""
    assert recording.position_command is not None
    spec = mujoco.MjSpec.from_file(str(path))
    last = spec.bodies[-1]
    model = spec.compile()
    up = -model.opt.gravity / np.linalg.norm(model.opt.gravity)
    tip = TIP * model.body_ipos[model.nbody - 1]
    data = mujoco.MjData(model)
    z = np.array([height(model, data, q, tip, up) for q in recording.position_command])
    if np.ptp(z) < 0.02 or not model.nu:
        return None
    free, _ = followed(model, recording)
    table = float(np.quantile(z, share))
    last.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0], pos=tip, mass=0.0)
    axis = np.zeros(4)
    mujoco.mju_quatZ2Vec(axis, up)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 1], pos=table * up, quat=axis, solref=[0.01, 1.0]
    )
    q, touches = followed(spec.compile(), recording)
    if not touches.any():
        return None
    moved = np.quantile(np.abs(q - free)[touches], 0.9, axis=0)
    steps = np.eye(model.nv) * 1e-4
    levers = np.array([[height(model, data, x + step, tip, up) for step in steps] for x in q[touches]])
    levers -= np.array([[height(model, data, x, tip, up)] for x in q[touches]])
    lifts = np.sqrt(np.mean(levers**2, axis=0))
    both = np.argsort(lifts)[-2:]
    clear = lifts[both[0]] > LIFTS * lifts[both[1]]
    clear = clear and float(touches.mean() * np.ptp(recording.t)) > LONG_S
    clear = clear and CLEAR_RAD[0] < moved[both].min() and moved[both].max() < CLEAR_RAD[1]
    return Recording(t=recording.t, position=q, position_command=recording.position_command), touches, bool(clear)


def followed(model: Any, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Positions along the recorded commands (K, n), and rows of contact (K,)."""
    assert recording.position_command is not None
    data = mujoco.MjData(model)
    data.qpos[:] = recording.position_command[0]
    q, touches = np.empty_like(recording.position), np.zeros(len(recording.t), bool)
    steps = np.diff(recording.t, append=2 * recording.t[-1] - recording.t[-2]) / model.opt.timestep
    for k, count in enumerate(np.rint(steps).astype(int)):
        q[k], touches[k] = data.qpos, data.ncon > 0
        data.ctrl[:] = recording.position_command[k]
        mujoco.mj_step(model, data, max(1, count))
    return q, touches


def height(model: Any, data: Any, q: np.ndarray, tip: np.ndarray, up: np.ndarray) -> float:
    """Height of the tip [m]."""
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return float(up @ (data.xpos[-1] + data.xmat[-1].reshape(3, 3) @ tip))


def main() -> int:
    """Make, look, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--cases", type=int, default=60)
    given = parser.parse_args()
    apart = wrong = 0
    seen: list[tuple[bool, bool, float, float]] = []
    for seed in given.seeds:
        random = np.random.default_rng(seed)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder)
            make_cases(folder, seed, given.cases, 2, (36.0, 18.0), positions=True)
            for case in sorted((out / "cases").iterdir()):
                arm = load_model(case / "sim.xml").arm
                train, held = (load_recording(case / f"{name}.csv") for name in ("train", "heldout"))
                apart += 1
                if find_surface(arm, [train, held]) is not None:
                    wrong += 1
                    print(f"seed {seed} {case.name}: a surface that is not there", flush=True)
                made = above_a_table(case / "sim.xml", train, random.uniform(0.04, 0.12))
                if made is None:
                    continue
                recording, touches, plain = made
                found = find_surface(arm, [recording])
                if found is None:
                    seen.append((plain, False, 0.0, 0.0))
                    continue
                rows = found.touched(arm, recording.t, recording.position)
                near = maximum_filter1d(touches.astype(np.uint8), 2 * round(0.5 / np.median(np.diff(recording.t))) + 1)
                seen.append((plain, True, float(rows[touches].mean()), float((near[rows] == 0).mean())))
    print(f"without a table: a surface in {wrong} of {apart}")
    clear = [each for each in seen if each[0]]
    found_all, found_clear = ([each for each in some if each[1]] for some in (seen, clear))
    share = len(found_clear) / max(len(clear), 1)
    print(f"with a table: {len(found_all)} of {len(seen)}; that two joints show clearly: {share:.0%} of {len(clear)}")
    within, beyond = (float(np.mean([each[k] for each in found_all])) for k in (2, 3))
    print(f"of the moments of contact {within:.0%} are left out; of those left out {beyond:.0%} are far from one")
    return int(wrong > FALSE * apart or share < FOUND)


if __name__ == "__main__":
    sys.exit(main())
