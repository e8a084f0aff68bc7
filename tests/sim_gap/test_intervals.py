"""The 95 % intervals hold the truth about 95 times in a hundred, correlated noise included."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter
from wrong_arms import Wrong, model, record

from sim_gap.effects.registry import layout_of
from sim_gap.estimate import Estimate
from sim_gap.model import load_model
from sim_gap.normal import ColumnStore, Term
from sim_gap.residual import ResidualSet
from sim_gap.signals import prepare

TRIALS = 60


def test_coverage(monkeypatch):
    """Of the part that is noise; what an arm that is a little wrong adds is left out here."""
    monkeypatch.setattr("sim_gap.estimate.SYSTEMATIC", 0.0)
    wrong = Wrong(coulomb=np.full(3, 0.5), viscous=np.full(3, 0.8))
    nominal = load_model(model())
    clean = record(model(), wrong, seconds=60, rate=50, noise=0.0, channels=("tau_motor",))
    held, widths = [], []
    for trial in range(TRIALS):
        random = np.random.default_rng(trial)
        noise = lfilter([0.3], [1.0, -0.95], random.normal(size=clean.position.shape), axis=0)  # 0.4 s long
        signals = prepare(replace(clean, motor_torque=clean.motor_torque + 0.2 * noise), nominal.arm)
        data = ResidualSet((signals,), layout_of([signals]))
        terms = [Term(effect, j) for effect in ("friction.coulomb", "friction.viscous") for j in range(3)]
        estimate = Estimate(ColumnStore(data), terms)
        for term in terms:
            (value,) = estimate.parameters(term).values()
            held.append(value.low <= (0.5 if term.effect == "friction.coulomb" else 0.8) <= value.high)
            widths.append(value.high - value.low)
    assert 0.88 <= np.mean(held) <= 0.99
    assert np.median(widths) < 0.3
