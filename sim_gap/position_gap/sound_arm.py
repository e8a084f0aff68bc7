"""Whether a gap is one that a sound arm may have: that of a model whose parameters are known as well as they can be.

Gains, damping, friction, inertia, mass moments (NOMINAL) and the time of the command of the nominal model are off by a
little each, with a known standard deviation. Their most probable values given the training recordings say what such
errors make of the gap; what they leave, and how improbable they are, says whether there is more to it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from gcomp.arrays import Array
from sim_gap.position_gap.fit import Layout, LoopSearch, Place, acting, jacobian, rms_on
from sim_gap.position_gap.windows import Windows
from sim_gap.search.estimate import NOMINAL

FRICTION_NM, FRICTION_SHARE = 0.02, 0.15
"""Standard deviation of Coulomb friction that models leave out, of bearings and seals [N·m]; at most this share of the
joint's torque."""
LATE_S, APART_S = 2e-3, 5e-4
"""Standard deviations of the time at which commands take effect against that of their rows, at all joints alike and at
each by itself [s]: clocks, cycles of bus and servo, filters of velocity."""
PROBABLE = 0.99
"""Share of sound arms whose errors are less improbable."""
LEAST_SHOWN = 0.5
"""Least share of its variance by which an error is judged by itself: what shows less takes on what others leave."""


def omitted_of(search: LoopSearch) -> dict[str, Array]:
    """Standard deviation of what sound arms have and models leave out: friction [N·m] and lateness [s], (J,) each."""
    friction = np.minimum(FRICTION_NM, FRICTION_SHARE * search.scales.torque)
    return {"coulomb": friction, "delay": np.full_like(friction, np.hypot(LATE_S, APART_S))}


def errors_of(search: LoopSearch) -> dict[Place, float]:
    """Standard deviation of each parameter of a sound arm in its own coordinate, of joints and links."""
    nominal, scales, omitted = search.nominal, search.scales, omitted_of(search)
    deviation = {
        "viscous": NOMINAL * nominal["viscous"],
        "coulomb": np.hypot(NOMINAL * nominal["coulomb"], omitted["coulomb"]),
        "armature": NOMINAL * scales.inertia,
        "delay": omitted["delay"],
    }
    out: dict[Place, float] = {}
    for j in range(search.data.joints):
        out[j, "kp"] = NOMINAL
        out |= {(j, name): float(x[j] / scales.of(name)[j]) for name, x in deviation.items() if x[j] > 0.0}
    moments = NOMINAL * np.linalg.norm(search.arm.inertial[:, 1:4], axis=1)
    return out | {(-1, f"moment{link}.{axis}"): size for link, size in enumerate(moments.tolist()) for axis in "xyz"}


def sound_gap(search: LoopSearch, heldout: Windows, margin: Array) -> tuple[Array, bool]:
    """RMS of the gap that errors of one standard deviation each make together, (J,) [rad]; and whether small errors
    explain the nominal model's gap: a sound arm may have the most probable ones, and they leave nothing that matters.

    `margin` is the RMS that counts as a gap at each joint, (J,) [rad].
    """
    sizes = errors_of(search)
    usually = _correlation(sizes)
    prior = np.linalg.inv(usually)
    gaps, changes = _weighed(search, sizes)
    usual = np.array([np.linalg.norm(x) for x in changes])
    normal, right = prior.copy(), np.zeros(len(sizes))
    for gap, x, samples, least in zip(gaps, changes, search.samples, margin, strict=True):
        normal += samples / least**2 * x @ x.T
        right -= samples / least**2 * x @ gap
    spread = np.asarray(np.linalg.inv(normal))
    errors = spread @ right
    layout, other = Layout(search, search.nominal, [*sizes]), replace(search, data=heldout)
    found = layout.at(layout.theta + np.array([*sizes.values()]) * errors)
    pairs = [(rms_on(each.data, found) / margin, each.samples) for each in (search, other)]
    small = [bool(np.all(left**2 * samples < _rare(samples))) for left, samples in pairs]
    return usual, all(small) and probable(errors, usually, spread)


def probable(errors: Array, usually: Array, spread: Array) -> bool:
    """Whether sound arms have such most probable errors: all of them together, and the largest by itself.

    `usually` is the covariance of errors, `spread` that of what the recordings leave open of them, (K, K).
    """
    shown = usually - spread
    prior = np.linalg.inv(usually)
    together = float(errors @ prior @ errors) < float(_rare(max(float(np.trace(prior @ shown)), 1.0)))
    largest = (errors**2 / np.maximum(np.diag(shown), LEAST_SHOWN)).max()
    return together and bool(largest < chi2.ppf(PROBABLE ** (1.0 / errors.size), 1))


def _rare(count: Array | float) -> Array:
    """Sum of the squares of so many standard normal values that is exceeded by chance in few cases."""
    return np.asarray(chi2.ppf(PROBABLE, count))


def _correlation(sizes: Mapping[Place, float]) -> Array:
    """Correlation of the errors, (K, K): commands are late at all joints alike."""
    late = np.array([name == "delay" for _, name in sizes], float)
    share = LATE_S**2 / (LATE_S**2 + APART_S**2)
    return np.asarray(np.diag(1.0 - share * late) + share * np.outer(late, late))


def _weighed(search: LoopSearch, sizes: Mapping[Place, float]) -> tuple[list[Array], list[Array]]:
    """The nominal model's gap at each joint (N,) and its changes by a standard deviation of each parameter (K, N), such
    that their norms are RMS values [rad]."""
    data, places, deviations = search.data, [*sizes], np.array([*sizes.values()])
    now, slopes = jacobian(search, search.nominal, places)
    gaps, changes = [], []
    for j, slope in enumerate(slopes):
        count = np.sqrt(max(float(data.weight[:, j].sum()), 1.0))
        change = np.zeros((len(places), now[:, j].size))
        change[acting(places, j)] = slope.reshape(len(slope), -1)
        gaps.append(now[:, j].ravel() / count)
        changes.append(change * deviations[:, None] / count)
    return gaps, changes
