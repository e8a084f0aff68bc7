"""mujoco.sysid 4: friction, damping, armature and servo gain of every joint and a payload, from windows of the motion.

As its documentation advises: a sequence a window from the measured state, bounds about the nominal values, its own
optimizer, 95 % intervals by `calculate_intervals`. It is told the quantities; it is not made for naming causes.
"""

import time
from typing import Any

import mujoco
import mujoco.sysid as sysid
import numpy as np
from referee import mjcf
from referee.interface import Answer, Case
from referee.signals import SEARCH_SHARE, drive, windows

STEP_S, WINDOWS, SECONDS = 0.004, 24, {"positions": 3.0}


def solve(case: Case) -> Answer:
    spec, names = mjcf.driven(case, STEP_S), list(case.joints)
    for name in names:
        kind = {"type": mujoco.mjtSensor.mjSENS_JOINTPOS, "objtype": mujoco.mjtObj.mjOBJ_JOINT}
        spec.add_sensor(name=f"{name} at", objname=name, **kind)
    wanted, model = sysid.ParameterDict(), spec.compile()
    for quantity in mjcf.allowed(case, mjcf.QUANTITIES if case.kind == "positions" else mjcf.QUANTITIES[:3]):
        for name, torque in zip(names, mjcf.largest(case), strict=True):
            start = mjcf.value_of(spec, quantity, name)
            high = max(5.0 * start, {"frictionloss": 0.5, "damping": 1.0}.get(quantity, 0.0) * torque + 1e-3)
            low = 0.2 * start if quantity == "kp" else 0.0
            add(wanted, quantity, name, float(np.clip(start, 0.01 * high, 0.99 * high)), low, high)
    last = mjcf.value_of(spec, "mass", names[-1])
    for quantity in mjcf.allowed(case, ["mass"]):
        add(wanted, quantity, names[-1], last, 0.5 * last, 3.0 * last + 1.0)
    states, controls, seen = [], [], []
    for r, part, speed in windows(case, SECONDS.get(case.kind, 0.5), WINDOWS):
        t, sensed = r.t[part] - r.t[part.start], [(f"{name} at", sysid.SignalType.MjSensor) for name in names]
        states.append(sysid.create_initial_state(model, r["q"][part.start], speed[part.start]))
        controls.append(sysid.TimeSeries.from_control_names(t, drive(case, r)[part], model, names))
        seen.append(sysid.TimeSeries.from_names(t, r["q"][part], model, sensed))
    labels = [f"window {k}" for k in range(len(seen))]
    residual = sysid.build_residual_fn(
        models_sequences=[sysid.ModelSequences("arm", spec, labels, states, controls, seen)], n_threads=1
    )
    x, began = wanted.as_vector(), time.process_time()
    residual(x, wanted)
    rounds = (SEARCH_SHARE * case.cpu_seconds - began) / ((len(x) + 2) * (time.process_time() - began))
    fitted, ended = sysid.optimize(wanted, residual, verbose=False, max_iters=max(int(rounds), 1))
    _, half = sysid.calculate_intervals(residual(ended.x, fitted)[0], ended.jac)
    words = fitted.keys()
    keys = [tuple(word.split(" ", 1)) for word in words]
    values = dict(zip(keys, map(float, ended.x), strict=True))
    widths = {key: float(h) for key, h in zip(keys, half, strict=True) if np.isfinite(h)}
    return Answer("mujoco", None, mjcf.parameters(case, values, widths), mjcf.corrected(case, values))


def add(wanted: Any, quantity: str, name: str, start: float, low: float, high: float) -> None:
    put = lambda spec, p: mjcf.put(spec, quantity, name, float(p.value[0]))  # noqa: E731
    wanted.add(sysid.Parameter(f"{quantity} {name}", start, low, high, modifier=put))
