"""BAM (PyPI `better-actuator-models`): friction model M4 of one servo on a pendulum, by CMA-ES as its `bam.fit` has it.

Weight and length are the model's. `bam.to_mujoco` writes gain, damping, friction and armature, which its authors call
an approximation: load-dependent friction is not in MJCF. BAM needs Python 3.12, so `make referee` gives it its own.
"""

import numpy as np
from bam.actuator import VoltageControlledActuator
from bam.model import models
from bam.parameter import Parameter
from bam.simulate import Simulator
from bam.testbench import Pendulum
from bam.to_mujoco import to_mujoco
from referee import mjcf
from referee.cma import lowest
from referee.interface import Answer, Case, NotOffered
from referee.signals import SEARCH_SHARE, at, held, windows

STEP_S, SECONDS, WINDOWS, UNLIMITED = 0.005, 4.0, 14, 1e6


class Servo(VoltageControlledActuator):
    """A servo without a limit of its voltage."""

    def initialize(self) -> None:
        super().initialize()
        self.model.armature = Parameter(0.02, 0.001, 0.1)

    def get_extra_inertia(self) -> float:
        return float(self.model.armature.value)


def solve(case: Case) -> Answer:
    if case.kind != "positions" or len(case.joints) > 1:
        raise NotOffered("one servo on a pendulum")
    body, joint, clock = mjcf.spec_of(case).compile(), case.joints[0], np.arange(0.0, SECONDS - STEP_S, STEP_S)
    kp = mjcf.value_of(mjcf.spec_of(case), "kp", joint)
    parts = [(r, r.t[k.start] + clock, v) for r, k, v in windows(case, SECONDS, WINDOWS)]
    q = np.concatenate([at(t, r.t, r["q"]) for r, t, _ in parts], axis=1)
    speed = np.concatenate([at(t, r.t, v) for r, t, v in parts], axis=1)
    goal = np.concatenate([held(t, r.t, r["q_cmd"]) for r, t, _ in parts], axis=1)
    rows = zip(q, speed, goal, strict=True)
    entries = [{"position": x, "speed": v, "goal_position": g, "torque_enable": True} for x, v, g in rows]
    log = {"mass": float(body.body_mass[-1]), "length": float(np.linalg.norm(body.body_ipos[-1])), "arm_mass": 0.0}
    log |= {"kp": 1.0, "vin": kp, "dt": STEP_S, "entries": entries}
    bam = models["m4"]()
    bam.max_friction_base = 0.2 * kp
    bam.set_actuator(Servo(Pendulum, vin=kp, kp=1.0, max_pwm=UNLIMITED))
    sought = [p for p in bam.get_parameters().values() if p.optimize]
    low, high = (np.array([getattr(p, end) for p in sought]) for end in ("min", "max"))

    def cost(x: np.ndarray) -> float:
        for p, value in zip(sought, np.maximum(low + x**2 * (high - low), np.where(low < 0.0, low, 1e-6)), strict=True):
            p.value = float(value)
        return float(np.mean(np.abs(np.array(Simulator(bam).rollout_log(log, simulate_control=True)[0]) - q)))

    cost(lowest(cost, np.full(len(low), 0.35), 0.2, SEARCH_SHARE * case.cpu_seconds))
    made = to_mujoco(bam.actuator) | {"kp": to_mujoco(bam.actuator)["kp"] / UNLIMITED}
    values = {(name, joint): float(made[name]) for name in mjcf.QUANTITIES}
    return Answer("mujoco", None, mjcf.parameters(case, values, {}), mjcf.corrected(case, values))
