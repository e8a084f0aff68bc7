"""Samples that the comparison leaves aside: motor rows at rest and in creep, disturbances, lines above the band."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from armlink.recording.recording import Recording
from gcomp.arrays import Array, Mask
from sim_gap.residuals.channel_quality import spectrum
from sim_gap.residuals.disturbances import are_far_off, calm_weight, disturbances
from sim_gap.residuals.layout import Row
from sim_gap.residuals.location import Location
from sim_gap.residuals.preprocess import BAND_HZ, CHANNELS, PreparedSignals
from sim_gap.residuals.residual_set import ResidualSet, root_mean_square

AT_REST = 0.05
"""Share of motion in the filter's window below which a joint is at rest; above, and without sliding, it creeps."""
FEWEST = 25
"""Number of samples from which a regime is judged."""
ABOVE = 1.5
"""Multiple of the pass band's end from which lines are looked for."""
SHARP, ASIDE, BESIDE = 30.0, 3, 20
"""A line exceeds the median of the bins from ASIDE to BESIDE bins away by this factor."""

HUMP, NEAR, FAR = 8.0, 1.3, 1.8
"""A resonance exceeds the median on either side, between these multiples of its frequency, by this factor."""
SMOOTH, FEW_BINS, BROAD = 5, 6, 2.0
"""Bins over which a spectrum is averaged to look for a resonance; fewest bins on either side to judge it by; multiple
of a line's power from which it counts before the line."""


def regimes_left_out(data: ResidualSet) -> dict[tuple[Row, str], Mask]:
    """Samples at rest and in creep of each motor row that the comparison leaves out, (K,)."""
    share = np.concatenate([s.filtered(s.moving) for s in data.signals])
    out = {}
    for channel, joint in data.rows:
        row = (channel, joint)
        if channel != data.layout.motor:
            continue
        known = np.concatenate([_known(data, s, row) for s in data.signals])
        aside = known & ~data.valid[row] & ~_hit(data)
        still = share[:, joint] < AT_REST
        out[row, "rest"], out[row, "creep"] = aside & still, aside & ~still
    return out


def share_left_out(data: ResidualSet) -> float:
    """Share of all samples that no row judges: not read, stuck, or near impacts of a gear."""
    judged = {row: data.valid[row].copy() for row in data.rows}
    for (row, _), mask in regimes_left_out(data).items():
        judged[row] |= mask
    return 1.0 - float(np.mean([mask.mean() for mask in judged.values()]))


def without_disturbances(data: ResidualSet, explained: Mapping[Row, Array]) -> ResidualSet:
    """The recordings with the samples of disturbances not `known`; the set itself if there are none.

    `explained` is the prediction of an estimate, (K,) per row.
    """
    signals, first = [], 0
    for s, length in zip(data.signals, data.lengths, strict=True):
        part = slice(first, first + length)
        far, judged, left = np.zeros((length, s.n), bool), np.zeros((length, s.n), bool), np.zeros((length, s.n))
        for row in data.rows:
            valid, joint = data.valid[row][part], row[1]
            rest = (data.values[row] - explained[row])[part] * valid
            far[:, joint] |= are_far_off(rest, valid, data.floor[row], data.margin[row])
            judged[:, joint] |= valid
            left[:, joint] = np.maximum(left[:, joint], np.abs(rest))
        found = disturbances(data.time[part], far, judged, left)
        if found:
            quiet = calm_weight(s.t, found)[:, None]
            known = {channel: there * quiet for channel, there in s.known.items()}
            s = replace(s, known=known, disturbances=(*s.disturbances, *found))
        signals.append(s)
        first += length
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
    """Lines and resonances above the pass band: the largest of each channel and joint, with frequency and RMS [N·m]."""
    names, best = data.signals[0].arm.names, dict[Row, Location]()
    for recording in recordings:
        for channel, name in CHANNELS.items():
            values = getattr(recording, name)
            for joint in range(len(names)) if values is not None else ():
                found = _peak(recording.t, values[:, joint])
                row = (channel, joint)
                if found and (row not in best or found[1] > best[row].rms):
                    hz, rms, share = found
                    noise = data.floor.get(row, 0.0)
                    clear = rms > max(data.relevant_nm, 2.0 * noise)
                    best[row] = Location(names[joint], channel, "band", rms, noise, share, hz, clear)
    return [each for each in best.values() if each.clear]


def _peak(t: Array, values: Array) -> tuple[float, float, float] | None:
    """Frequency [Hz], RMS and share of the power above the band of the sharpest line there, else of the highest
    resonance; None without one."""
    there = np.isfinite(values)
    if there.sum() < 1024:
        return None
    own, x = t[there], values[there]
    step = float(np.median(np.diff(own)))
    even = np.arange(own[0], own[-1], step)
    frequency, density = spectrum(np.interp(even, own, x), 1.0 / step)
    line, hump = _line(frequency, density), _resonance(frequency, density)
    found = hump if line is None or (hump is not None and hump[1] > BROAD * line[1]) else line
    if found is None:
        return None
    hz, power = found
    total = float(np.sum(density[frequency > BAND_HZ]) * frequency[1])
    return hz, float(np.sqrt(max(power, 0.0))), min(power / max(total, 1e-300), 1.0)


def _line(frequency: Array, density: Array) -> tuple[float, float] | None:
    """Frequency and power of the highest bin, if it stands alone."""
    bins = np.flatnonzero(frequency > ABOVE * BAND_HZ)
    bins = bins[(bins >= BESIDE) & (bins < len(density) - ASIDE)]
    if len(bins) < 2 * BESIDE:
        return None
    peak = int(bins[np.argmax(density[bins])])
    around = np.r_[peak - BESIDE : peak - ASIDE, peak + ASIDE + 1 : min(peak + BESIDE + 1, len(density))]
    level = float(np.median(density[around]))
    if density[peak] < SHARP * level:
        return None
    return float(frequency[peak]), float(np.sum(density[peak - 2 : peak + 3] - level) * frequency[1])


def _resonance(frequency: Array, density: Array) -> tuple[float, float] | None:
    """Frequency and power of the highest hump that falls off on either side, too broad for a line."""
    smooth = np.convolve(density, np.ones(SMOOTH) / SMOOTH, mode="same")
    highest = np.r_[False, (smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:]), False]
    best: tuple[float, float] | None = None
    for peak in np.flatnonzero(highest & (frequency > ABOVE * BAND_HZ)).tolist():
        f = frequency[peak]
        below = (frequency >= max(f / FAR, BAND_HZ)) & (frequency <= f / NEAR)
        above = (frequency >= f * NEAR) & (frequency <= f * FAR)
        if min(below.sum(), above.sum()) < FEW_BINS:
            continue
        level = max(float(np.median(density[side])) for side in (below, above))
        if smooth[peak] < HUMP * level:
            continue
        own = (frequency > f / NEAR) & (frequency < f * NEAR)
        power = float(np.sum(density[own] - level) * frequency[1])
        if smooth[peak] == smooth[own].max() and (best is None or power > best[1]):
            best = float(f), power
    return best


def _known(data: ResidualSet, s: PreparedSignals, row: Row) -> Mask:
    there = s.filtered(s.known[row[0]][:, row[1]]) > 0.9
    reference = data.layout.reference(row)
    return there & (s.filtered(s.known[reference][:, row[1]]) > 0.9) if reference else there


def _hit(data: ResidualSet) -> Mask:
    return np.asarray(np.any([np.zeros(sum(data.lengths), bool), *data.impacts.values()], axis=0))
