"""A three-joint arm at 100 Hz: the whole daemon on it is quick enough to be watched in a browser by a test."""

from pathlib import Path

from armlink.arm_file import ArmFile, parse_arm

ROWS = {"base": (0.0, 1.5708, 0.2), "shoulder": (0.4, 0.0, 0.0), "elbow": (0.3, 0.0, 0.0)}
LINKS = ((4.0, [0.0, 0.0, -0.1]), (3.0, [0.2, 0.02, 0.0]), (1.5, [0.15, 0.0, 0.01]))


def small_arm() -> ArmFile:
    """Axes 2 and 3 parallel; with this gravity every joint is loaded."""
    joints = [
        {"name": name, "a": a, "alpha": alpha, "d": d, "lower": -1.4, "upper": 1.6}
        for name, (a, alpha, d) in ROWS.items()
    ]
    link = [
        {"name": name, "node": k, "rated_torque": rated, "max_torque": 1.4 * rated}
        for k, (name, rated) in enumerate(zip(ROWS, (60.0, 60.0, 30.0), strict=True), start=1)
    ]
    links = [{"mass": mass, "com": com, "inertia": [0.02, 0.02, 0.02]} for mass, com in LINKS]
    content = {
        "name": "small",
        "serial": "SIM-0003",
        "kinematics": {"gravity": [0.0, -9.81, 0.0], "joints": joints},
        "link": {"bus": {"interface": "armlink_sim", "channel": "small.yaml"}, "rate": 100, "joints": link},
        "sim": {"links": links},
    }
    return parse_arm(content, Path("small.yaml"))
