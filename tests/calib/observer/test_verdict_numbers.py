"""Numbers that come with a verdict, in cases that can be counted by hand."""

import numpy as np
import pytest
from effects_on_readings import SIGMA, payload

from calib.observer.cause_test import CauseTest
from calib.observer.evidence import smallest_noticed_change
from calib.observer.gravity_belief import GravityBelief
from gcomp.gravity.torque import gravity_torque
from gcomp.identify.readings import StaticReadings


def test_a_change_that_a_rival_resembles_must_be_larger_and_less_so_where_the_rival_costs_more():
    """Without noise the change wins with the evidence asked for, and with no more."""
    random, rows, evidence = np.random.default_rng(2), 50, 6.0
    own, other = random.standard_normal((2, rows))
    basis = np.linalg.qr(np.column_stack([own + 0.5 * other, random.standard_normal(rows)]))[0]
    once = np.log(rows)
    sizes = {}
    for name, rivals in (("none", []), ("simple", [(basis, 1)]), ("dear", [(basis, 2)])):
        sizes[name] = size = smallest_noticed_change(own, rivals, evidence)
        change = size * own
        left = change - basis @ (basis.T @ change)
        against = [change @ change - once, *(left @ left + (price - 1) * once for _, price in rivals)]
        assert min(against) == pytest.approx(evidence)
    assert sizes["none"] < sizes["dear"] < sizes["simple"]


def test_the_misfit_of_readings_without_noise_counts_what_was_fitted_to_them(sarcos, sarcos_beta):
    """χ² is 0, of as many degrees of freedom as there are readings less the payload's mass and its three moments."""
    random = np.random.default_rng(3)
    q = random.uniform(sarcos.lower, sarcos.upper, (3, sarcos.n))
    direction, v = np.ones(q.shape), gravity_torque(sarcos, sarcos_beta, q)
    payload(0.5)(sarcos, sarcos_beta, q, direction, v, random)
    belief = GravityBelief(sarcos, sarcos_beta, np.zeros((sarcos_beta.size, sarcos_beta.size)))
    readings = StaticReadings(q, v, np.full(sarcos.n, SIGMA), direction=direction)
    verdict = CauseTest(belief, readings).verdict()
    assert verdict.cause == "payload"
    assert verdict.evidence["misfit"] == pytest.approx(-np.sqrt((q.size - 4) / 2), abs=0.006)
