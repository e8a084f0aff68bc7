"""Arm files for tests."""

from pathlib import Path

from armlink.armfile import ArmFile, parse_arm


def arm_of(n: int = 3, **link) -> ArmFile:
    joints = [{"name": f"joint_{i}", "d": 0.1, "lower": -2.0, "upper": 2.0} for i in range(1, n + 1)]
    linked = [{"name": f"joint_{i}", "node": i, "rated_torque": 40.0, "max_torque": 30.0} for i in range(1, n + 1)]
    content = {"name": "test", "kinematics": {"joints": joints}, "link": {"joints": linked, **link}}
    return parse_arm(content, Path("test.yaml"))
