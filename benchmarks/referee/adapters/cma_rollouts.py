"""CMA-ES over MuJoCo roll-outs, the method of PACE: armature, damping and friction of each joint and one delay.

Roll-outs follow the recorded commands (or torques) over windows from measured states; CMA-ES (PyPI `cmaes`) lowers the
mean square error of positions. PACE takes the gains of the servos as known, and gives neither intervals nor causes.
"""

import mujoco
import numpy as np
from mujoco import rollout
from referee import mjcf
from referee.cma import lowest
from referee.interface import Answer, Case, Parameter
from referee.signals import SEARCH_SHARE, at, drive, held, windows

STEP_S, WINDOWS, SECONDS, LONGEST_DELAY_S = 0.004, 16, {"positions": 3.0}, 0.08
SHARES = {"frictionloss": 0.5, "damping": 0.5, "armature": 0.3}
"""Largest values sought, as shares of a joint's largest torque in training; at least five times the nominal value."""


def solve(case: Case) -> Answer:
    spec, names, n = mjcf.driven(case, STEP_S), list(case.joints), len(case.joints)
    order, model = [names.index(servo.target) for servo in spec.actuators], spec.compile()
    clock = np.arange(round(SECONDS.get(case.kind, 0.4) / STEP_S)) * STEP_S
    data, dofs = mujoco.MjData(model), {name: int(model.joint(name).dofadr[0]) for name in names}
    sought = mjcf.allowed(case, SHARES)
    keys, top = [(q, name) for q in sought for name in names], np.outer([SHARES[q] for q in sought], mjcf.largest(case))
    start = np.array([mjcf.value_of(spec, *key) for key in keys])
    top = np.maximum(5.0 * start, top.ravel() + 1e-3)
    parts = windows(case, SECONDS.get(case.kind, 0.4) + STEP_S, WINDOWS)
    states = np.array([np.concatenate([[0.0], r["q"][k.start], v[k.start], np.zeros(model.na)]) for r, k, v in parts])
    seen = np.array([at(r.t[k.start] + clock + STEP_S, r.t, r["q"]) for r, k, _ in parts])

    def values(x: np.ndarray) -> dict[tuple[str, str], float]:
        return dict(zip(keys, (x[:-1] ** 2 * top).tolist(), strict=True))

    def cost(x: np.ndarray) -> float:
        for (quantity, name), value in values(x).items():
            getattr(model, f"dof_{quantity}")[dofs[name]] = value
        late = clock - x[-1] * LONGEST_DELAY_S
        given = np.array([held(r.t[k.start] + late, r.t, drive(case, r))[:, order] for r, k, _ in parts])
        made = rollout.rollout(model, data, states, given)[0][:, :, 1 : 1 + n]
        return float(np.mean(np.clip(np.nan_to_num(made - seen, nan=3.0), -3.0, 3.0) ** 2))

    first = np.append(np.sqrt(np.clip(start / top, 0.0025, 0.9)), 0.05)
    best = lowest(cost, first, 0.15, SEARCH_SHARE * case.cpu_seconds)
    found = values(best)
    late = Parameter("delay", "", float(best[-1] * LONGEST_DELAY_S))
    return Answer("mujoco", None, [*mjcf.parameters(case, found, {}), late], mjcf.corrected(case, found))
