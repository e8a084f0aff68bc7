"""A position-controlled arm without torques: the diagnosis against mujoco.sysid, which is told what to fit.

    python tests/campaigns/servo_peer.py --sim MODEL.xml --train REC … --heldout REC … [--written CLOSED.xml]

mujoco.sysid gets gain, friction loss, damping and armature of every joint with bounds, windows of the training
recordings, and friction that rests as that of a gear does. Both models then run free along the commands of the held-out
recordings. `--written` is the model of an earlier diagnosis of the same recordings (`--out-model`), which is not
repeated then. Exit status 1 if the diagnosis leaves more than mujoco.sysid over all joints, or more than 0.4 of the
nominal model's gap.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import mujoco.sysid as peer
import numpy as np

from armlink.recording.files import load_recording
from armlink.recording.recording import Recording
from sim_gap.attribution.diagnose import diagnose
from sim_gap.model.load import load_model
from sim_gap.position_gap.training.replay import Simulated, replay_rms

WINDOW_S, STEP_S = 6.0, 0.004
STICKS = (0.999, 0.9999, 0.001, 0.5, 2.0)
"""`solimpfriction` with which a joint does not creep under its load."""
FITTED = {"gain": (20.0, 1.0, 400.0), "frictionloss": (0.1, 0.0, 2.0), "damping": (0.6, 0.0, 5.0)}
FITTED |= {"armature": (0.028, 0.001, 0.2)}
"""Start and bounds of each quantity of a joint."""
GOAL = 0.4


def setter(joint: str, quantity: str) -> Callable[[Any, Any], None]:
    """Function that writes a fitted value into the model."""

    def put(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0])
        if quantity == "gain":
            spec.actuator(joint).gainprm[0], spec.actuator(joint).biasprm[1] = value, -value
        elif quantity == "damping":
            spec.joint(joint).damping[0] = value
        else:
            setattr(spec.joint(joint), quantity, value)

    return put


def spec_of(sim: Path) -> tuple[Any, list[str]]:
    """The model with a position sensor a joint, its actuators named after their joints and without damping."""
    spec = mujoco.MjSpec.from_file(str(sim))
    for actuator in spec.actuators:
        actuator.name, actuator.biasprm[2] = actuator.target, 0.0
    for joint in spec.joints:
        joint.solimp_friction = STICKS
        kinds = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
        spec.add_sensor(name=f"{joint.name} at", type=kinds[0], objtype=kinds[1], objname=joint.name)
    spec.option.timestep = STEP_S
    return spec, [joint.name for joint in spec.joints]


def windows(recordings: Sequence[Recording], count: int) -> list[tuple[Recording, slice]]:
    """At most `count` windows, evenly spread."""
    found = []
    for recording in recordings:
        rows = round(WINDOW_S / float(np.median(np.diff(recording.t))))
        found += [(recording, slice(k, k + rows)) for k in range(0, len(recording.t) - rows, rows)]
    return [found[k] for k in np.unique(np.linspace(0, len(found) - 1, min(count, len(found))).round().astype(int))]


def fitted_by_peer(sim: Path, train: Sequence[Recording], count: int) -> Any:
    """The model as mujoco.sysid fits it."""
    spec, names = spec_of(sim)
    model, parameters = spec.compile(), peer.ParameterDict()
    for name in names:
        for quantity, (start, low, high) in FITTED.items():
            put = setter(name, quantity)
            parameters.add(peer.Parameter(f"{name} {quantity}", start, low, high, modifier=put))
    sensed = [(f"{name} at", peer.SignalType.MjSensor) for name in names]
    states, controls, seen = [], [], []
    for recording, part in windows(train, count):
        speed = np.gradient(recording.position, recording.t, axis=0)
        t = recording.t[part] - recording.t[part.start]
        states.append(peer.create_initial_state(model, recording.position[part.start], speed[part.start]))
        controls.append(peer.TimeSeries.from_control_names(t, recording.position_command[part], model, names))
        seen.append(peer.TimeSeries.from_names(t, recording.position[part], model, sensed))
    labels = [f"window {k}" for k in range(len(seen))]
    sequences = peer.ModelSequences(str(sim), spec, labels, states, controls, seen)
    residual = peer.build_residual_fn(models_sequences=[sequences], n_threads=1)
    found, _ = peer.optimize(parameters, residual, verbose=False)
    for name in names:
        values = {quantity: float(found[f"{name} {quantity}"].value[0]) for quantity in FITTED}
        print(f"  {name}: " + ", ".join(f"{quantity} {value:.4g}" for quantity, value in values.items()))
        for quantity in FITTED:
            setter(name, quantity)(spec, found[f"{name} {quantity}"])
    return spec.compile()


def main() -> int:
    """Fit both, replay the held-out recordings, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sim", type=Path, required=True)
    parser.add_argument("--train", type=Path, nargs="+", required=True)
    parser.add_argument("--heldout", type=Path, nargs="+", required=True)
    parser.add_argument("--windows", type=int, default=20)
    parser.add_argument("--written", type=Path)
    given = parser.parse_args()
    train, heldout = ([load_recording(path) for path in paths] for paths in (given.train, given.heldout))
    nominal = load_model(given.sim, (), train[0].n)
    joints, started = nominal.joints, time.process_time()
    if given.written:
        ours = mujoco.MjModel.from_xml_path(str(given.written))
    else:
        ours = mujoco.MjModel.from_xml_string(diagnose(given.sim, train, heldout).internals.export.xml)
    middle = time.process_time()
    theirs = fitted_by_peer(given.sim, train, given.windows)
    ended = time.process_time()
    gaps = {"nominal": replay_rms(Simulated(nominal.mujoco_model, joints), heldout)}
    gaps |= {
        name: replay_rms(Simulated(model, joints), heldout)
        for name, model in (("diagnosis", ours), ("mujoco.sysid", theirs))
    }
    whole = {name: float(np.sqrt(np.mean(gap**2))) for name, gap in gaps.items()}
    for name, gap in gaps.items():
        print(f"{name:13s} {' '.join(f'{x:.4f}' for x in gap)} rad, all joints {whole[name]:.4f}")
    print(f"diagnosis {whole['diagnosis'] / whole['nominal']:.2f} of nominal, joint by joint ", end="")
    print(" ".join(f"{x:.2f}" for x in gaps["diagnosis"] / gaps["nominal"]), end="; ")
    print(f"{whole['diagnosis'] / whole['mujoco.sysid']:.2f} of mujoco.sysid")
    print(f"processor time: diagnosis {middle - started:.0f} s, mujoco.sysid {ended - middle:.0f} s")
    return int(whole["diagnosis"] > min(GOAL * whole["nominal"], whole["mujoco.sysid"]))


if __name__ == "__main__":
    sys.exit(main())
