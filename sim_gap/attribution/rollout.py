"""Roll-outs of what is written: simulations with the exported model and its effects from recorded states.

The whole, each effect added alone, and each left out alone. The windows are short, for an arm with open-loop torque
drifts away in any case. Each model comes from the text that `--out-model` writes.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array
from sim_gap.attribution.diagnosis import Cause, EffectRollout, Rollout
from sim_gap.better_model import forward_effects
from sim_gap.better_model.export import CorrectedText, joint_effects, model_files, with_effects
from sim_gap.better_model.forward_effects import Effects, JointEffect
from sim_gap.model.load import SimModel, named_spec, silent
from sim_gap.residuals.preprocess import CHANNELS
from sim_gap.residuals.residual_set import ResidualSet
from sim_gap.search.estimate import EffectEstimate
from sim_gap.search.term import Term

FEW_WINDOWS = 6
"""Number of windows of each of these."""
NAME = "model.xml"


class RollOuts:
    """Simulations of the exported files along held-out recordings."""

    def __init__(
        self,
        sim: SimModel,
        heldout: ResidualSet,
        recordings: Sequence[Recording],
        estimate: EffectEstimate,
        laws: Sequence[JointEffect] = (),
    ) -> None:
        """`laws` go with every simulation of effects, none with that of the nominal model."""
        self.sim, self.recordings, self.estimate, self.laws = sim, recordings, estimate, tuple(laws)
        self.spec = named_spec(sim) if sim.path is not None else None
        self.bodies = [(s.number, s.mount) for s in heldout.signals]
        self.channel = CHANNELS[heldout.layout.motor_side]
        self.source = {"tau_motor": "motor", "tau_cmd": "command", "tau": "sensor"}[heldout.layout.motor_side]

    def of(self, terms: Sequence[Term], windows: int) -> Array:
        """Deviation per joint with these terms [rad], RMS over the windows of all recordings, (n,)."""
        share, squares = max(1, windows // len(self.recordings)), []
        bodies = any(term.effect == "link.payload" for term in terms)
        made: dict[tuple[int, float], tuple[Any, Effects]] = {}
        for r, body in zip(self.recordings, self.bodies, strict=True):
            body = body if bodies else (0, 0.0)
            if body not in made:
                made[body] = self._arm(terms, *body)
            model, effects = made[body]
            torque = getattr(r, self.channel)
            with silent():
                stray = forward_effects.roll_out(model, effects, r.t, r.position, torque, self.source, windows=share)
            squares.append(stray**2)
        return np.asarray(np.sqrt(np.nanmean(squares, axis=0)))

    def _arm(self, terms: Sequence[Term], number: int, mount: float) -> tuple[Any, Effects]:
        """Model and effects beside it with these terms as they are written for one recording."""
        laws = self.laws if terms else ()
        if self.sim.path is None:  # a compiled model has no file to write
            corrected = with_effects(self.sim, self.estimate, terms, number, mount)
            model, beside = corrected.model, joint_effects(self.sim, self.estimate, corrected.not_held, corrected.held)
            return model, Effects(model, [*beside, *laws], self.sim.arm.names)
        files = model_files(self.sim, self.estimate, NAME, terms, number, laws, self.spec, mount)
        model = _compiled(files)
        return model, Effects(model, files.effects, self.sim.arm.names)


def roll_out(
    sim: SimModel,
    heldout: ResidualSet,
    recordings: Sequence[Recording],
    estimate: EffectEstimate,
    causes: Sequence[Cause],
    laws: Sequence[JointEffect] = (),
) -> Rollout:
    """Position gap per joint of the nominal model, of the whole correction, and with each cause added or left out."""
    runs = RollOuts(sim, heldout, recordings, estimate, laws)
    horizon, windows = forward_effects.HORIZON_S, forward_effects.WINDOWS
    before = runs.of((), windows)
    if not estimate.terms:
        return Rollout(horizon, before, before)
    after = runs.of(estimate.terms, windows)
    out = []
    for cause in causes[:12]:  # most important first
        own = [term for term in estimate.terms if term.effect == cause.effect]
        rest = [term for term in estimate.terms if term not in own and not {t.key for t in own} & {*term.beneath}]
        needed = [term for term in estimate.terms if any(term.key in t.beneath for t in own)]
        alone, without = (runs.of(terms, FEW_WINDOWS) for terms in ([*needed, *own], rest))
        out.append(EffectRollout(cause.effect, cause.joints, alone, without))
    cost = lambda each: -float(np.nanmax(each.without))  # noqa: E731
    return Rollout(horizon, before, after, tuple(sorted(out, key=cost)))


def _compiled(files: CorrectedText) -> Any:
    """The model from its text; from the same specification if it refers to files beside it."""
    import mujoco

    try:
        return mujoco.MjModel.from_xml_string(files.xml)
    except ValueError:
        return files.spec.compile()
