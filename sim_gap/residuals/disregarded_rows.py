"""Samples that the comparison leaves aside: motor rows at rest and in creep, disturbances, lines above the band.

In a disturbance several joints at once are far from what they do all the rest of the time: something touches the arm,
or a burst of torques is misread. A property of the arm would show whenever it moves like that, so that such a moment
says nothing of it. Its samples are left out of the comparison, and it is reported.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation, label, maximum_filter1d
from scipy.signal import find_peaks, peak_widths

from armlink.recording.recording import Recording
from gcomp.arm.rigid_body import RigidArm
from gcomp.arrays import Array, Mask
from sim_gap.residuals.channel_quality import TIMES_USUAL, Disturbance, spectrum
from sim_gap.residuals.layout import Row
from sim_gap.residuals.preprocess import BAND_HZ, CHANNELS, TRIM_S
from sim_gap.residuals.residual_set import FEWEST, MOVING_SHARE, Location, ResidualSet, root_mean_square

LOWEST_PEAK_HZ = 1.5 * BAND_HZ
"""Frequency from which peaks are looked for [Hz]."""
PEAK_HEIGHT = 8.0
"""Height of a peak of the spectrum over the higher of its two feet. Averages of some twenty spectra over SMOOTHED_BINS
vary by a tenth, so that noise has no such peaks."""
SMOOTHED_BINS = 5
"""Number of bins over which a spectrum is averaged to look for peaks."""


def regimes_left_out(data: ResidualSet) -> dict[tuple[Row, str], Mask]:
    """Samples at rest and in creep of each motor row that the comparison leaves out, (K,)."""
    share = np.concatenate([s.filtered(s.moving) for s in data.signals])
    out = {}
    for row in data.rows:
        if row[0] == data.layout.motor:
            aside = data.read[row] & ~data.valid[row] & data.calm
            still = share[:, row[1]] < 1.0 - MOVING_SHARE  # above, and without sliding, it creeps
            out[row, "rest"], out[row, "creep"] = aside & still, aside & ~still
    return out


def share_left_out(data: ResidualSet) -> float:
    """Share of all samples that no row judges: not read, stuck, or near impacts of a gear."""
    judged = {row: data.valid[row].copy() for row in data.rows}
    for (row, _), mask in regimes_left_out(data).items():
        judged[row] |= mask
    return 1.0 - float(np.mean([mask.mean() for mask in judged.values()]))


JOINTS, SHARE = 3, 0.5
"""Least number of joints that are far off at once, and least share of those that are judged then."""
AT_ONCE_S = 0.12
"""Time within which joints are far off at once [s]."""
LONGEST_S = 0.6
"""Longest disturbance, without the time around it [s]: what lasts is a property of the arm, or a body it took up."""
RARE = 0.02
"""Largest share of a recording's time that is disturbed: what happens more often is a property of the arm."""


def are_far_off(left: Array, valid: Mask, noise: float, margin: float) -> Mask:
    """Samples of one row at which what remains (K,) is as far from usual as a spike and more than noise and margin
    [N·m], (K,)."""
    if not valid.any():
        return np.zeros(len(left), bool)
    usual = max(1.4826 * float(np.median(np.abs(left[valid]))), noise)
    return np.asarray(valid & (np.abs(left) > max(TIMES_USUAL * usual, margin)))


def disturbances(time: Array, far: Mask, judged: Mask, left: Array) -> tuple[Disturbance, ...]:
    """Disturbances of one recording from the samples (K, n) of each joint that are far off and those that are judged.

    `time` (K,) is even [s]; `left` (K, n) is what remains at each joint [N·m].
    """
    if not far.any():
        return ()
    half = max(1, round(AT_ONCE_S / float(time[1] - time[0])))
    together, able = (maximum_filter1d(mask.astype(np.uint8), 2 * half + 1, axis=0).sum(1) for mask in (far, judged))
    disturbed = far.any(1) & (together >= np.maximum(JOINTS, SHARE * able))
    if not 0.0 < disturbed.mean() <= RARE:
        return ()
    runs, count = label(binary_dilation(disturbed, iterations=half))
    out = []
    for number in range(1, count + 1):
        own = np.flatnonzero((runs == number) & disturbed)
        largest = np.abs(left[own]).max(0)
        joint = int(np.argmax(largest))
        out.append(Disturbance(float(time[own[0]]), float(time[own[-1]]), joint, float(largest[joint])))
    return tuple(one for one in out if one.end - one.start <= LONGEST_S)


def without_disturbances(data: ResidualSet, explained: Mapping[Row, Array]) -> ResidualSet:
    """The recordings with the samples of disturbances and around them not `known`; the set itself if there are none.

    `explained` is the prediction of an estimate, (K,) per row.
    """
    signals = []
    for s, part in zip(data.signals, data.parts, strict=True):
        left = np.zeros((part.stop - part.start, s.n))
        far, judged = np.zeros(left.shape, bool), np.zeros(left.shape, bool)
        for row in data.rows:
            valid, joint = data.valid[row][part], row[1]
            rest = (data.values[row] - explained[row])[part] * valid
            far[:, joint] |= are_far_off(rest, valid, data.floor[row], data.margin[row])
            judged[:, joint] |= valid
            left[:, joint] = np.maximum(left[:, joint], np.abs(rest))
        found = disturbances(data.time[part], far, judged, left)
        if found:
            around = [(s.t >= one.start - TRIM_S) & (s.t <= one.end + TRIM_S) for one in found]
            known = {channel: there * ~np.any(around, axis=0)[:, None] for channel, there in s.known.items()}
            s = replace(s, known=known, disturbances=(*s.disturbances, *found))
        signals.append(s)
    same = all(new is old for new, old in zip(signals, data.signals, strict=True))
    return data if same else ResidualSet(tuple(signals), data.layout)


def slides(data: ResidualSet, row: Row) -> bool:
    """Whether a joint slides for long enough that its friction is known."""
    return int(data.valid[row].sum()) >= FEWEST


def slow_gaps(
    data: ResidualSet, explained: Mapping[Row, Array], friction: Array, known: Collection[Row]
) -> list[Location]:
    """Rows at rest and in creep; `friction` (n,) is the known dry friction [N·m], which may take any value there.

    A location is `clear` if more remains there than that friction and the row's margin. Of a joint that does not slide
    in the training data, which `known` then does not hold, the friction is not known: nothing is clear there.
    """
    names, out = data.signals[0].arm.names, []
    for (row, regime), mask in regimes_left_out(data).items():
        if mask.sum() < FEWEST:
            continue
        raw, left = data.values[row][mask], (data.values[row] - explained[row])[mask]
        clear = row in known and root_mean_square(left) > data.margin[row] + float(friction[row[1]])
        share = float(np.sum(raw**2) / max(np.sum(raw**2) + np.sum(data.values[row][data.valid[row]] ** 2), 1e-12))
        out.append(Location(names[row[1]], row[0], regime, root_mean_square(raw), data.floor[row], share, clear=clear))
    return out


def fast_gaps(data: ResidualSet, recordings: Sequence[Recording]) -> list[Location]:
    """Lines and resonances above the pass band: the largest of each channel and joint, with frequency and RMS [N·m].

    One is a gap if it is more than the inertia of the arm asks for there, the positions with their noise being what the
    arm did: a servo that rings moves the arm.
    """
    arm, best = data.signals[0].arm, dict[Row, Location]()
    for recording in recordings:
        inertia = _mass_matrix(arm, np.nanmean(recording.position, axis=0))
        for channel, name in CHANNELS.items():
            values = getattr(recording, name)
            for joint in range(arm.n) if values is not None else ():
                row, moved = (channel, joint), recording.position @ inertia[joint]
                noise = data.floor.get(row, 0.0)
                least = max(data.relevant_nm, 2.0 * noise, best[row].rms if row in best else 0.0)
                for rms, hz, band, share in _peaks(recording.t, values[:, joint]):
                    if rms <= least:
                        break
                    if rms > 2.0 * np.hypot(noise, _asked(recording.t, moved, band)):
                        best[row] = Location(arm.names[joint], channel, "band", rms, noise, share, hz, clear=True)
                        break
    return list(best.values())


def _mass_matrix(arm: RigidArm, q: Array) -> Array:
    """Inertia of links and rotors at positions (n,), (n, n) [kg·m²]."""
    rows, none = np.eye(arm.n), np.zeros((arm.n, arm.n))
    return arm.torque(np.tile(q, (arm.n, 1)), none, rows, np.zeros(3)) + np.diag(arm.armature)


def _spectrum(t: Array, values: Array) -> tuple[Array, Array] | None:
    """Frequencies [Hz] and power spectral density of readings; None of too few."""
    there = np.isfinite(values)
    if there.sum() < 1024:
        return None
    own = t[there]
    step = float(np.median(np.diff(own)))
    return spectrum(np.interp(np.arange(own[0], own[-1], step), own, values[there]), 1.0 / step)


def _asked(t: Array, moved: Array, band: tuple[float, float]) -> float:
    """RMS torque [N·m] in a band [Hz] that inertia times position `moved` (K,) [kg·m²] asks for; 0 if unknown."""
    frequency, density = _spectrum(t, moved) or np.zeros((2, 2))
    inside = (frequency >= band[0]) & (frequency <= band[1])
    return float(np.sqrt(np.sum(density[inside] * (2.0 * np.pi * frequency[inside]) ** 4) * frequency[1]))


def _peaks(t: Array, values: Array) -> list[tuple[float, float, tuple[float, float], float]]:
    """RMS, frequency [Hz], the band that it fills [Hz], and share of the power above the pass band of each line or
    resonance there, the strongest first."""
    if (made := _spectrum(t, values)) is None:
        return []
    frequency, density = made
    smooth = np.log(np.convolve(density, np.ones(SMOOTHED_BINS) / SMOOTHED_BINS, mode="same") + 1e-300)
    peaks, shapes = find_peaks(smooth, prominence=np.log(PEAK_HEIGHT))
    left, right = peak_widths(smooth, peaks, rel_height=0.9)[2:]
    total, found = float(np.sum(density[frequency > BAND_HZ]) * frequency[1]), []
    for k in np.flatnonzero(frequency[peaks] > LOWEST_PEAK_HZ).tolist():
        inside = slice(int(np.floor(left[k])), int(np.ceil(right[k])) + 1)
        foot = float(np.exp(smooth[peaks[k]] - shapes["prominences"][k]))
        power = float(np.sum(np.maximum(density[inside] - foot, 0.0)) * frequency[1])
        own, share = frequency[inside], min(power / max(total, 1e-300), 1.0)
        found.append((float(np.sqrt(power)), float(own[np.argmax(density[inside])]), (own[0], own[-1]), share))
    return sorted(found, reverse=True)
