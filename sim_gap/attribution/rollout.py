"""Forward simulation from recorded states with recorded torque: deviation of the simulated from the real joints.

Effects that a MuJoCo model can hold are put into it; the torque of the others along the recorded motion is subtracted
from the driving torque. The windows are short, for an arm with open-loop torque drifts away in any case.
"""

from typing import Any

import numpy as np

from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import Rollout
from sim_gap.better_model.with_effects import CorrectedModel, with_effects
from sim_gap.model.load import SimModel
from sim_gap.residuals.layout import Layout
from sim_gap.residuals.preprocess import Signals
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.estimate import Estimate

HORIZON_S = 0.5
WINDOWS = 40
STEP_S = 0.002
LOST, WILD = np.pi, 50.0
"""Limits of a joint's deviation [rad] and speed [rad/s]: without friction and rotor inertia a light joint would diverge
and the simulation with it."""
LOCKED = 1e9
"""Armature of joints of the model that the recording does not have [kg·m²]: they stay at rest."""


def roll_out(sim: SimModel, heldout: ResidualSet, estimate: Estimate | None) -> Rollout:
    """Position gap per joint, RMS over the windows [rad], of the nominal model and of the model with the effects."""
    before = _gap(sim, with_effects(sim, None), heldout, None)
    after = before if estimate is None else _gap(sim, with_effects(sim, estimate), heldout, estimate)
    return Rollout(HORIZON_S, before, after)


def _gap(sim: SimModel, corrected: CorrectedModel, heldout: ResidualSet, estimate: Estimate | None) -> Array:
    model = corrected.model
    _prepare(model, sim)
    squares, count = np.zeros(sim.n), 0
    for signals in heldout.signals:
        drive = signals.reading[heldout.layout.motor_side] - _not_held(signals, heldout.layout, corrected, estimate)
        steps = round(HORIZON_S * signals.rate)
        last = len(signals.t) - steps - 1
        share = max(1, WINDOWS // len(heldout.signals))
        for start in np.unique(np.linspace(0.0, last, share).astype(int)) if last > 0 else []:
            stray = _window(model, sim, signals, drive, int(start), steps)
            squares += np.mean(stray**2, axis=0)
            count += 1
    return np.asarray(np.sqrt(squares / max(count, 1)))


def _prepare(model: Any, sim: SimModel) -> None:
    import mujoco

    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    own = model.jnt_dofadr[list(sim.joints)]
    others = np.setdiff1d(np.arange(model.nv), own)
    model.dof_armature[others] = LOCKED


def _not_held(signals: Signals, layout: Layout, corrected: CorrectedModel, estimate: Estimate | None) -> Array:
    """Torque at the motor (without one, at the sensor) of the effects that the model cannot hold, (K, n)."""
    out = np.zeros_like(signals.q)
    for term in corrected.not_held:
        assert estimate is not None
        columns = term.form.signature.columns(signals, layout, term.place, term.shape)
        for (channel, joint), x in columns.items():
            if channel != layout.command:
                out[:, joint] += x @ estimate.of(term)
    return out


def _window(model: Any, sim: SimModel, signals: Signals, drive: Array, start: int, steps: int) -> Array:
    """Simulated minus recorded position over one window, (steps, n)."""
    import mujoco

    each = max(1, int(np.ceil(1.0 / signals.rate / STEP_S)))
    model.opt.timestep = 1.0 / signals.rate / each
    data = mujoco.MjData(model)
    adr, dof = model.jnt_qposadr[list(sim.joints)], model.jnt_dofadr[list(sim.joints)]
    data.qpos[adr], data.qvel[dof] = signals.q[start], signals.v[start]
    out = np.empty((steps, sim.n))
    for k in range(steps):
        data.qfrc_applied[dof] = 0.5 * (drive[start + k] + drive[start + k + 1])
        for _ in range(each):
            mujoco.mj_step(model, data)
            np.clip(data.qvel, -WILD, WILD, out=data.qvel)
        out[k] = data.qpos[adr] - signals.q[start + k + 1]
    return np.clip(out, -LOST, LOST)
