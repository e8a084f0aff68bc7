"""An arm of two joints in a vertical plane, with bodies that touch what stands there."""

from pathlib import Path

import numpy as np

from armlink.arm_file import ArmFile, load_arm

MODEL = """
<mujoco><compiler angle="radian"/><worldbody>{obstacle}
  <body name="upper"><joint name="shoulder" axis="0 1 0" range="-1.2 1.2"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" mass="2"/>
    <body name="fore" pos="0.4 0 0"><joint name="elbow" axis="0 1 0" range="-1.5 1.5"/>
      <geom type="capsule" size="0.03" fromto="0.05 0 0 0.35 0 0" mass="1"/></body></body>
</worldbody></mujoco>"""
ARM = """
name: bench
kinematics: {model: bench.xml, tip: fore}
link:
  joints:
    - {name: shoulder, node: 1, rated_torque: 20.0, max_torque: 30.0}
    - {name: elbow, node: 2, rated_torque: 10.0, max_torque: 15.0}
"""


def bench(folder: Path, obstacle: str = "") -> ArmFile:
    """Two joints in a vertical plane: positive angles go down."""
    (folder / "bench.xml").write_text(MODEL.format(obstacle=obstacle), encoding="utf-8")
    (folder / "bench.yaml").write_text(ARM, encoding="utf-8")
    return load_arm(str(folder / "bench.yaml"))


def post(x: float, z: float, half: float = 0.05) -> str:
    """A box on the arm's own plane [m]."""
    return f'<body name="post" pos="{x} 0 {z}"><geom type="box" size="{half} {half} {half}"/></body>'


def along(shoulder: float, elbow: float, share: float) -> tuple[float, float]:
    """Place (x, z) [m] on the forearm at angles [rad], by plane trigonometry."""
    reach = 0.05 + 0.3 * share
    x = 0.4 * np.cos(shoulder) + reach * np.cos(shoulder + elbow)
    return float(x), float(-0.4 * np.sin(shoulder) - reach * np.sin(shoulder + elbow))
