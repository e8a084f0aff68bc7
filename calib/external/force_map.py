"""A picture of the smallest force that is felt at the tool, over the workspace."""

from pathlib import Path

import numpy as np

from armlink.content.atomic_file import write_whole
from calib.external.listening import WrenchFrame
from gcomp.arrays import Array, joined
from gcomp.external.contact import ContactDetector
from gcomp.external.external_model import ExternalModel
from gcomp.external.filtered_rows import Samples
from gcomp.external.wrench import force_found

POSES, DIRECTIONS = 600, 8
"""Poses drawn over the joints' range, and directions of the force at each."""
CELLS = 24
"""Cells of the picture along either side."""
SIZE = 480
"""Side of the picture [pixels]."""
COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""From the smallest force to the largest: viridis (matplotlib)."""


def smallest_forces(model: ExternalModel, frame: WrenchFrame, per_hour: float) -> tuple[Array, Array]:
    """(Places (K, 2): distance from the first axis' origin and height against gravity [m]; forces (K,) [N]) at rest."""
    arm, random = model.arm, np.random.default_rng(1)
    low, high = (np.clip(each, -np.pi, np.pi) for each in (arm.lower, arm.upper))
    poses = random.uniform(low, high, (POSES, arm.n))
    rows = []
    for pose in poses:
        still = np.zeros((1, arm.n))
        rows.append(model.rows(model.filter(1.0).rows(Samples(pose[None], still, still, still))))
    every = joined(rows)
    detector = ContactDetector(model, per_hour, frame.point)
    std = model.sudden.std(every.state, np.zeros_like(every.left))
    ways = random.normal(size=(DIRECTIONS, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    motion = every.motion
    force = np.median([force_found(detector, motion, frame.link, frame.point, way, std) for way in ways], axis=0)
    at = motion.origin[:, frame.link] + motion.rotation[:, frame.link] @ frame.point
    up = -arm.gravity / np.linalg.norm(arm.gravity)
    height = at @ up
    return np.column_stack([np.linalg.norm(at - np.outer(height, up), axis=1), height]), np.asarray(force)


def draw_map(path: Path, places: Array, force: Array, title: str) -> None:
    """Write the picture as SVG: medians of each cell."""
    low, high = places.min(axis=0), places.max(axis=0)
    cell = np.minimum(((places - low) / np.maximum(high - low, 1e-9) * CELLS).astype(int), CELLS - 1)
    log = np.log(np.clip(force, 1e-3, 1e6))
    first, last = np.quantile(log, [0.02, 0.98])
    side = SIZE / CELLS
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{SIZE + 180}" height="{SIZE + 70}" '
        'font-family="sans-serif" font-size="13"><rect width="100%" height="100%" fill="white"/>',
        f'<text x="50" y="20">{title}</text>',
    ]
    for column in range(CELLS):
        for row in range(CELLS):
            inside = (cell[:, 0] == column) & (cell[:, 1] == row)
            if inside.any():
                colour = _colour((float(np.median(log[inside])) - first) / max(last - first, 1e-9))
                x, y = 50 + column * side, 30 + (CELLS - 1 - row) * side
                parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{side:.1f}" height="{side:.1f}" fill="{colour}"/>')
    for share in np.linspace(0.0, 1.0, len(COLOURS)):
        y = 40 + (1.0 - share) * (SIZE - 60)
        parts.append(f'<rect x="{SIZE + 70}" y="{y:.1f}" width="20" height="20" fill="{_colour(share)}"/>')
        value = float(np.exp(first + share * (last - first)))
        parts.append(f'<text x="{SIZE + 96}" y="{y + 15:.1f}">{value:.3g} N</text>')
    for x, y, text in (
        (50, SIZE + 48, f"{low[0]:.2f} m"), (SIZE, SIZE + 48, f"{high[0]:.2f} m"), (SIZE / 2 - 40, SIZE + 64, "reach"),
        (4, SIZE + 26, f"{low[1]:.2f}"), (4, 42, f"{high[1]:.2f}"), (4, SIZE / 2, "height"),
    ):  # fmt: skip
        parts.append(f'<text x="{x}" y="{y}">{text}</text>')
    write_whole(path, "\n".join([*parts, "</svg>"]) + "\n")


def _colour(share: float) -> str:
    place = float(np.clip(share, 0.0, 1.0)) * (len(COLOURS) - 1)
    k = min(int(place), len(COLOURS) - 2)
    mixed = [round(a + (place - k) * (b - a)) for a, b in zip(COLOURS[k], COLOURS[k + 1], strict=True)]
    return f"rgb({mixed[0]},{mixed[1]},{mixed[2]})"
