"""Published arms as URDF and MJCF text, and their torque by MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np

from gcomp.arrays import Array

HALF = np.pi / 2


UR10 = [  # xyz, rpy, axis, mass, com: as in the UR description, shoulder, upper arm and forearm axes parallel
    ((0, 0, 0.1273), (0, 0, 0), (0, 0, 1), 7.778, (0, 0, 0.01)),
    ((0, 0.220941, 0), (0, HALF, 0), (0, 1, 0), 12.93, (0, 0, 0.306)),
    ((0, -0.1719, 0.612), (0, 0, 0), (0, 1, 0), 3.87, (0, 0.01, 0.2862)),
    ((0, 0, 0.5723), (0, HALF, 0), (0, 1, 0), 1.96, (0, 0.1149, 0)),
    ((0, 0.1149, 0), (0, 0, 0), (0, 0, 1), 1.96, (0.01, 0, 0.1157)),
    ((0, 0, 0.1157), (0, 0, 0), (0, 1, 0), 0.202, (0, 0.0922, 0.005)),
]


PANDA = [
    ((0, 0, 0.333), (0, 0, 0), (0, 0, 1), 4.97, (0.0039, 0.0021, -0.048)),
    ((0, 0, 0), (-HALF, 0, 0), (0, 0, 1), 0.647, (-0.0031, -0.029, 0.0035)),
    ((0, -0.316, 0), (HALF, 0, 0), (0, 0, 1), 3.23, (0.0275, 0.0393, -0.0665)),
    ((0.0825, 0, 0), (HALF, 0, 0), (0, 0, 1), 3.59, (-0.0532, 0.1044, 0.0275)),
    ((-0.0825, 0.384, 0), (-HALF, 0, 0), (0, 0, 1), 1.23, (-0.0114, 0.0412, -0.0385)),
    ((0, 0, 0), (HALF, 0, 0), (0, 0, 1), 1.67, (0.0601, -0.0144, -0.0105)),
    ((0.088, 0, 0), (HALF, 0, 0), (0, 0, 1), 0.735, (0.0105, -0.0043, 0.0616)),
]


IIWA = [
    ((0, 0, 0.1475), (0, 0, 0), (0, 0, 1), 3.95, (0, -0.03, 0.12)),
    ((0, -0.0105, 0.1925), (-HALF, 0, 0), (0, 0, -1), 4.5, (0.0003, 0.059, 0.042)),
    ((0, 0.0105, -0.2075), (1.5708, 3.1416, 0), (0, 0, 1), 2.46, (0, 0.03, 0.13)),  # rounded as such files are
    ((0, -0.0105, 0.1925), (1.5708, 0, 0), (0, 0, 1), 2.61, (0, 0.067, 0.034)),
    ((0, 0.0105, -0.2075), (-1.5708, 3.1416, 0), (0, 0, 1), 3.41, (0.0001, 0.021, 0.076)),
    ((0, -0.0707, 0.1925), (1.5708, 0, 0), (0.6, 0, 0.8), 3.39, (0, 0.0006, 0.0004)),
    ((0, 0.0707, -0.091), (-1.5708, 3.1416, 0), (0, 0, 1), 0.354, (0, 0, 0.02)),
]


def urdf(rows: list, base_rpy: tuple[float, ...] = (0, 0, 0)) -> str:
    """A URDF with a massless first link, a fixed joint in the middle of the chain and a tool welded to its end."""

    def text(values: tuple[float, ...]) -> str:
        return " ".join(map(repr, values))

    def link(name: str, mass: float = 0.0, com: tuple[float, ...] = (0, 0, 0)) -> str:
        inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
        shape = '<visual><geometry><mesh filename="package://nowhere/missing.stl"/></geometry></visual>'
        inner = f'<inertial><origin xyz="{text(com)}"/><mass value="{mass}"/>{inertia}</inertial>{shape}'
        return f'<link name="{name}">{inner if mass else ""}</link>'

    def joint(name: str, kind: str, parent: str, child: str, xyz: tuple, rpy: tuple, axis: tuple = (0, 0, 1)) -> str:
        return (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/><axis xyz="{text(axis)}"/>'
            '<limit lower="-2.9" upper="2.8" effort="100" velocity="1"/></joint>'
        )

    parts = [link("world"), link("base", 4.0), joint("mount", "fixed", "world", "base", (0.1, 0.2, 0.3), base_rpy)]
    parent = "base"
    for i, (xyz, rpy, axis, mass, com) in enumerate(rows, start=1):
        parts += [link(f"link_{i}", mass, com), joint(f"joint_{i}", "revolute", parent, f"link_{i}", xyz, rpy, axis)]
        parent = f"link_{i}"
        if i == 3:
            parts += [link("cover", 0.3, (0.02, 0.03, 0.04))]
            parts += [joint("screw", "fixed", parent, "cover", (0.05, 0, 0.1), (0.3, -0.2, 0.1))]
    parts += [
        link("tool", 0.7, (0.01, -0.02, 0.05)),
        joint("weld", "fixed", parent, "tool", (0, 0, 0.1), (0.1, 0.2, 0)),
    ]
    return '<?xml version="1.0"?><robot name="arm">' + "".join(parts) + "</robot>"


def mujoco_torque(path: Path, q: Array) -> Array:
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rows = mujoco.MjData(model), []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        rows.append(data.qfrc_bias.copy())
    return np.array(rows)


MJCF = """<mujoco><compiler angle="degree" eulerseq="zyx"/><option gravity="1 2 -9"/>
<default><default class="j"><joint type="hinge" axis="0 1 1" range="-100 120"/></default></default><worldbody>
<body name="base" euler="10 20 30"><geom size="0.1" mass="3"/>
<body name="a" pos="0.1 0.2 0.3" euler="15 25 35"><joint name="j1" class="j" pos="0.01 0.02 0.03" ref="20"/>
 <geom type="capsule" fromto="0 0 0 0.3 0.1 0.2" size="0.04"/>
 <body name="b" pos="0.3 0 0"><joint name="j2" class="j" axis="0 1 1"/><joint name="j3" class="j" axis="1 0 0"/>
  <inertial pos="0.01 0.02 0.1" mass="2" diaginertia="0.01 0.01 0.01"/>
  <body name="lump" pos="0 0 0.1"><geom size="0.03" mass="0.4" pos="0.1 0 0"/></body>
  <body name="c" pos="0 0.2 0.1" quat="0.8 0.1 0.2 0.5"><joint name="j4" class="j" limited="false"/>
   <geom type="box" size="0.05 0.02 0.1" pos="0 0.05 0" mass="1.2"/></body></body></body></body></worldbody></mujoco>"""
