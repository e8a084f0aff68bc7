"""Diagnosis among all effects against mujoco.sysid with the effect given: one recording, seven joints."""

from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from side_by_side import Case, Figure, seconds

from armlink.model_file import add_actuator
from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.attribution.diagnose import diagnose
from sim_gap.model.load import load_model, read_spec
from sim_gap.residuals.layout import layout_of
from sim_gap.residuals.preprocess import prepare
from sim_gap.residuals.residual_set import ResidualSet, by_joint, row_rms

ARM = "sarcos"
SECONDS, RATE = 30.0, 250.0
NOISE_NM = 0.02
SINES_HZ, SWING = np.array([0.08, 0.2, 0.4]), 0.15
"""About these frequencies, with this amplitude [rad], every joint swings."""
WINDOW_S = 0.5
"""mujoco.sysid simulates forward under the recorded torque; over a longer time an arm strays whatever drives it."""
LARGEST = 10.0
"""Bound that mujoco.sysid is given for friction loss [N·m] and damping [N·m·s/rad]."""


@dataclass(frozen=True)
class Wrong:
    """Effects of the recorded arm that the nominal model lacks, (n,) each."""

    frictionloss: Array
    damping: Array


def cases() -> list[Case]:
    """Time, and error on held-out data, of the same two fits."""
    peer = "mujoco.sysid fitting friction loss and damping of every joint"
    name = "diagnose_vs_mujoco_sysid"
    errors: tuple[Figure, Figure] = (lambda: float(ours().mean()), lambda: heldout_error(sysid()))
    return [
        Case(name, "s", seconds(ours), seconds(sysid), peer, runs=1, warm_up=False),
        Case(f"{name}_heldout", "N·m", *errors, peer, runs=1, warm_up=False),
    ]


@cache
def ours() -> Array:
    """The diagnosis, timed once: RMS per joint on held-out data after the diagnosis, (n,) [N·m]."""
    train, other = recordings()
    answer = diagnose(ARM, [train], [other])
    assert answer.verdict == "explained"
    return answer.heldout_after


@cache
def sysid() -> Wrong:
    """mujoco.sysid's fit, timed once, of the training recording."""
    import mujoco.sysid as peer

    train, _ = recordings()
    spec = _driven()
    model, names = spec.compile(), [joint.name for joint in spec.joints]
    parameters = peer.ParameterDict()
    for name in names:
        for quantity in ("frictionloss", "damping"):
            key = f"{name} {quantity}"
            parameters.add(peer.Parameter(key, 0.1, 0.0, LARGEST, modifier=_setter(name, quantity)))
    size = round(WINDOW_S * RATE)
    starts, t = range(0, len(train.t) - size, size), np.arange(size) / RATE
    speed = np.gradient(train.position, train.t, axis=0)
    sensed = [(f"{name} at", peer.SignalType.MjSensor) for name in names]
    windows = [slice(start, start + size) for start in starts]
    sequences = peer.ModelSequences(
        ARM,
        spec,
        [f"window {start}" for start in starts],
        [peer.create_initial_state(model, train.position[start], speed[start]) for start in starts],
        [peer.TimeSeries.from_control_names(t, train.motor_torque[w], model, names) for w in windows],
        [peer.TimeSeries.from_names(t, train.position[w], model, sensed) for w in windows],
    )
    with redirect_stdout(StringIO()):
        fitted, _ = peer.optimize(parameters, peer.build_residual_fn(models_sequences=[sequences]), verbose=False)
    values = np.array([[fitted[f"{name} {q}"].value[0] for q in ("frictionloss", "damping")] for name in names])
    return Wrong(values[:, 0], values[:, 1])


def heldout_error(fitted: Wrong) -> float:
    """Mean over the joints of the RMS on held-out data [N·m], with the diagnosis's own measure."""
    spec = read_spec(Path(ARM))
    _put(spec, fitted)
    signals = prepare(recordings()[1], load_model(spec.compile()).arm)
    data = ResidualSet((signals,), layout_of([signals]))
    return float(by_joint(data, row_rms(data)).mean())


@cache
def recordings() -> tuple[Recording, Recording]:
    """Training and held-out recordings of the same arm with errors."""
    random, n = np.random.default_rng(1), load_model(ARM).n
    wrong = Wrong(random.uniform(0.3, 2.0, n), random.uniform(0.3, 2.0, n))
    return _record(wrong, 1), _record(wrong, 2)


def _record(wrong: Wrong, seed: int) -> Recording:
    """Smooth motion about the middle of the joints' ranges, its torque by MuJoCo's inverse dynamics."""
    random, model = np.random.default_rng(seed), load_model(ARM).mujoco_model
    data, t = mujoco.MjData(model), np.arange(0.0, SECONDS, 1.0 / RATE)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    shape = 3, model.nv, 1
    omega = 2 * np.pi * SINES_HZ[:, None, None] * random.uniform(0.8, 1.2, shape)
    phase = random.uniform(0.0, 2 * np.pi, shape)
    q = ((SWING * np.sin(omega * t + phase)).sum(0) + model.jnt_range.mean(1, keepdims=True)).T
    v = (SWING * omega * np.cos(omega * t + phase)).sum(0).T
    a = (-SWING * omega**2 * np.sin(omega * t + phase)).sum(0).T
    torque = np.empty_like(q)
    for row in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], v[row], a[row]
        mujoco.mj_inverse(model, data)
        torque[row] = data.qfrc_inverse
    motor = torque + wrong.frictionloss * np.tanh(v / 0.002) + wrong.damping * v
    return Recording(t=t, position=q, motor_torque=motor + NOISE_NM * random.normal(size=q.shape))


def _driven() -> Any:
    """The nominal arm with a motor and a position sensor per joint, named after it, without stops and contacts."""
    spec = read_spec(Path(ARM))
    for old in (*spec.actuators, *spec.sensors):
        spec.delete(old)
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        add_actuator(spec, joint.name, joint.name)
        kinds = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
        spec.add_sensor(name=f"{joint.name} at", type=kinds[0], objtype=kinds[1], objname=joint.name)
    spec.option.timestep = 1.0 / RATE
    return spec


def _setter(joint: str, quantity: str) -> Callable[[Any, Any], None]:
    """Function that writes a fitted value into the model."""

    def put(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0])
        if quantity == "damping":
            spec.joint(joint).damping[0] = value
        else:
            spec.joint(joint).frictionloss = value

    return put


def _put(spec: Any, fitted: Wrong) -> None:
    for joint, loss, damping in zip(spec.joints, fitted.frictionloss, fitted.damping, strict=True):
        joint.frictionloss, joint.damping[0] = float(loss), float(damping)
