"""A small arm whose drives have no torque sensor, for tests that creep."""

from pathlib import Path
from typing import Any

import numpy as np

from armlink.arm_file import ArmFile, parse_arm

SIM: dict[str, Any] = {
    "links": [
        {"mass": 1.0, "com": [0.12, 0.01, 0.0], "inertia": [0.004] * 3},
        {"mass": 0.6, "com": [0.1, -0.02, 0.0], "inertia": [0.002] * 3},
    ],
    "quasi_direct": {},
    "step": 0.004,
}
JOINTS: list[dict[str, Any]] = [
    {"name": "upper", "a": 0.25, "alpha": 0.0, "lower": -1.4, "upper": 1.4},
    {"name": "fore", "a": 0.2, "alpha": np.pi / 2, "lower": -1.6, "upper": 1.6},
]
CREEP: dict[str, Any] = {"span": 1.0, "speeds": [0.3, 0.2], "bin": 0.12}


def soft_arm(motion: str | None = None) -> ArmFile:
    """Two Damiao drives, both axes horizontal."""
    keys = {"family": "damiao", "model": "DM4340", "kp": 50, "kd": 5}
    drives = [
        {"name": joint["name"], "drive": {**keys, "id": i, "reply": i + 16}, "rated_torque": 9.0, "max_torque": 22.0}
        for i, joint in enumerate(JOINTS, start=1)
    ]
    content = {
        "name": "two",
        "kinematics": {"gravity": [9.80665, 0.0, 0.0], "joints": JOINTS},
        "link": {"rate": 50, "joints": drives},
        "sweep": {"creep": CREEP, **({} if motion is None else {"motion": motion})},
        "sim": SIM,
    }
    return parse_arm(content, Path("two.yaml"))
