"""Links of a small arm whose drives have no torque sensor: the `sim` section of tests that creep."""

from typing import Any

import numpy as np

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
