"""A plan as a drawing and as a duration: one page that opens without a network."""

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile
from armlink.content.atomic_file import write_whole
from armlink.content.printable_text import printable_text
from calib.arm.kinematics import DriveLimits, frame_origins, gcomp_arm
from calib.arm.sweep_section import sweep_section
from calib.motion.trajectory import trajectory
from calib.plan.collisions import sweep_ends
from calib.plan.types import SCOUT_ACCELERATION, SCOUT_TITLE, SweepPlan
from gcomp.arrays import Array

PRESS, READ = 1.0, 0.5
"""Seconds for creeping onto stops and pressing, and for settling and averaging of one reading: estimates."""
SPEED_UP, STOP_CREEP = 0.3, 0.8
"""Seconds lost to speeding up and slowing down on a way, and for creeping onto a stop and off it again: estimates."""
COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#e377c2", "#8c564b")
"""One per joint."""


def reading_seconds(arm_file: ArmFile, plan: SweepPlan) -> Array:
    """Rough duration (readings,) of each reading of a pass of steps, with the way to it [s]."""
    section, limits = sweep_section(arm_file), DriveLimits.of(arm_file)
    period, speed = 0.02, section.travel_speed * limits.speed

    def travel(start: Array, goal: Array, acceleration: float) -> float:
        return period * len(trajectory(start, goal, speed, np.full(len(goal), acceleration), period))

    seconds, here = list[float](), np.array(plan.scout[0])
    for scouted in plan.scout:
        goal = np.array(scouted)
        seconds.append(travel(here, goal, SCOUT_ACCELERATION) + READ)
        here = goal
    for sweep in plan.sweeps:
        begin, _ = sweep_ends(sweep)
        one = np.zeros(len(here))
        one[sweep.joint] = abs(sweep.steps[-1] - sweep.steps[0]) / (len(sweep.steps) - 1)
        each = np.full(sweep.readings, travel(np.zeros(len(here)), one, sweep.acceleration) + READ)
        each[0] += travel(here, begin, plan.travel_acceleration) + PRESS
        seconds.extend(each)
        here = begin
    return np.array(seconds)


def stops_seconds(arm_file: ArmFile) -> float:
    """Rough time in which each joint looks for both its stops, the others mid-range, before the first pass [s]."""
    section, limits = sweep_section(arm_file), DriveLimits.of(arm_file)
    way = limits.upper - limits.lower  # half of it, all of it, half of it
    return float(np.sum(2 * way / (section.travel_speed * limits.speed) + 6 * SPEED_UP + 2 * (PRESS + STOP_CREEP)))


def draw_plan(arm_file: ArmFile, plan: SweepPlan, path: Path) -> None:
    """Write the drawing: stick figures of each sweep that can be turned, shown and hidden. Raises OSError."""
    import plotly.graph_objects as graph

    kinematics, figure = gcomp_arm(arm_file), graph.Figure()

    def draw(points: Array, **style: Any) -> None:
        x, y, z = points.T
        figure.add_scatter3d(x=x, y=y, z=z, **style)

    for sweep in plan.sweeps:
        begin, end = sweep_ends(sweep)
        poses = begin + np.linspace(0, 1, 4)[:, None] * (end - begin)
        points = np.concatenate(
            [np.vstack([places, np.full((1, 3), np.nan)]) for places in frame_origins(kinematics, poses)]
        )
        name, colour = escape(printable_text(sweep.name)), COLOURS[sweep.joint % len(COLOURS)]
        line, marker = {"width": 5, "color": colour}, {"size": 3, "color": colour}
        draw(points, mode="lines+markers", name=name, line=line, marker=marker)
    scouted = frame_origins(kinematics, np.array(plan.scout))[:, -1]
    draw(scouted, mode="markers", name=f"{SCOUT_TITLE} (tip)", marker={"size": 4, "color": "black"})
    down = kinematics.gravity / max(float(np.linalg.norm(kinematics.gravity)), 1e-9)
    length = 0.3 * max(float(np.abs(kinematics.span).sum()), 0.1)
    arrow = np.vstack([np.zeros(3), length * down])
    draw(arrow, mode="lines", name="gravity", line={"width": 8, "color": "grey"})
    figure.update_layout(
        title=f"{escape(printable_text(arm_file.name))}: poses of the plan (base frame, m)",
        scene={"aspectmode": "data", "camera": _camera(down)},
        height=800,
        margin={"l": 0, "r": 0, "b": 0},
        updatemenus=[{"buttons": _choices(plan), "x": 0.0, "xanchor": "left", "y": 1.0}],
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, figure.to_html(include_plotlyjs=True, full_html=True))


def _camera(down: Array) -> dict[str, dict[str, float]]:
    """A view from slightly above, with gravity pointing down on the screen."""
    up = -down if np.any(down) else np.array([0.0, 0.0, 1.0])
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    eye = 1.8 * (side / np.linalg.norm(side) + 0.6 * np.cross(up, side) + 0.35 * up)
    return {"up": dict(zip("xyz", up.tolist(), strict=True)), "eye": dict(zip("xyz", eye.tolist(), strict=True))}


def _choices(plan: SweepPlan) -> list[dict[str, Any]]:
    """Buttons: all sweeps, or one of them, with the direction of gravity."""
    count = len(plan.sweeps)
    shown = {"all sweeps": [True] * (count + 2)}
    shown |= {one.name: [*(one is other for other in plan.sweeps), False, True] for one in plan.sweeps}
    return [
        {"label": escape(printable_text(label)), "method": "update", "args": [{"visible": seen}]}
        for label, seen in shown.items()
    ]
