"""A two-joint arm with position servos in MuJoCo, as a stand-in for a real one; its recordings have no torque."""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from armlink.recording.recording import Recording
from sim_gap.model.load import load_model
from sim_gap.position_gap.fit import LoopFit, LoopSearch
from sim_gap.position_gap.plant import MovedModel, nominal_point
from sim_gap.position_gap.start import scales_of
from sim_gap.position_gap.windows import windows_of

JOINTS = ("shoulder", "elbow")


def model_text(
    kp: float, friction: float, damping: float = 0.8, limits: Sequence[float] = (), *, creeps: bool = False
) -> str:
    """MJCF of the arm: gravity about both joints, gains in N·m/rad, limits of the servos' torque in N·m.

    If it `creeps`, friction is as MuJoCo's usual solver parameters make it, else it holds a joint at rest.
    """
    limited = [f' forcerange="{-x} {x}"' for x in limits] or ["", ""]
    sticks = "" if creeps else 'solreffriction="0.01 1" solimpfriction="0.999 0.9999 0.001 0.5 2"'
    joint = f'axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="0.02" {sticks}'
    return f"""<mujoco model="servo_arm"><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="upper"><joint name="shoulder" {joint}/><inertial pos="0.1 0 0" mass="0.6" diaginertia="2e-3 2e-3 2e-3"/>
<body name="fore" pos="0.2 0 0"><joint name="elbow" {joint}/>
<inertial pos="0.08 0 0" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/></body></body></worldbody><actuator>
<position name="shoulder" joint="shoulder" kp="{kp}"{limited[0]}/>
<position name="elbow" joint="elbow" kp="{kp}"{limited[1]}/>
</actuator></mujoco>"""


def above_a_table(text: str, height: float) -> str:
    """The arm above a table at this height [m], that the end of its last link touches."""
    tip = '<geom type="sphere" size="0.001" pos="0.16 0 0" mass="0"/></body></body></worldbody>'
    table = f'<worldbody><geom type="plane" pos="0 0 {height}" size="1 1 0.1" solref="0.01 1"/>'
    return text.replace("</body></body></worldbody>", tip).replace("<worldbody>", table)


def record(
    text: str,
    seed: int,
    seconds: float,
    rate: float = 50.0,
    *,
    wide: float = 1.0,
    fast: float = 1.0,
    load: float = 0.0,
    breakaway: tuple[float, float] = (0.0, 1.0),
    released: float = np.inf,
) -> Recording:
    """Positions read with 12 bits, and the commands held from row to row: sines with rests between.

    `wide` and `fast` are the way and the frequencies of the motion over the usual ones, `load` the friction of the
    gears over the torque that the links carry, `breakaway` that at rest besides [N·m] and the velocity over which it
    fades [rad/s]. From `released` on [s] the servos are off, and there is no command.
    """
    random = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    t = np.arange(0.0, seconds, 1.0 / rate)
    waves = random.uniform(0.15, 0.9, (3, 2))
    phase = random.uniform(0.0, 6.0, (3, 2))
    moving = 6.0 * np.floor(t / 7.0) + np.minimum(t % 7.0, 6.0)  # a second of rest after six
    command = 0.3 * wide * np.sin(2 * np.pi * fast * waves * moving[:, None, None] + phase).sum(1)
    data.qpos[:], dry = command[0], model.dof_frictionloss.copy()
    q, steps = np.empty_like(command), round(1.0 / rate / model.opt.timestep)
    for k, row in enumerate(command):
        q[k] = data.qpos
        if t[k] >= released:
            model.actuator_gainprm[:], model.actuator_biasprm[:], command[k] = 0.0, 0.0, np.nan
        data.ctrl[:] = np.nan_to_num(row)
        for _ in range(steps):
            if load or breakaway[0]:
                fades = breakaway[0] * np.exp(-((data.qvel / breakaway[1]) ** 2))
                model.dof_frictionloss[:] = dry + fades + load * np.abs(_carried(model, data))
            mujoco.mj_step(model, data)
    count = 2 * np.pi / 4096
    return Recording(t=t, position=np.rint(q / count) * count, position_command=command, names=JOINTS)


def _carried(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Torque of the links in the last step: their inertia times acceleration, and gravity and velocity terms."""
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    return (whole - np.diag(model.dof_armature)) @ data.qacc + data.qfrc_bias


def written(folder: Path, text: str) -> Path:
    """The model as a file."""
    path = folder / "sim.xml"
    path.write_text(text, encoding="utf-8")
    return path


def fitted(*friction: float, weightless: bool = False) -> tuple[LoopSearch, LoopFit]:
    """A fit of gain, friction and damping to one recording of the arm with each friction [N·m].

    Without weight, neither gravity nor what inertia there is shows the scale of a torque.
    """
    changes = {"<option ": '<option gravity="0 0 0" ', 'mass="0.6"': 'mass="0.006"', 'mass="0.3"': 'mass="0.003"'}
    changes |= {"2e-3": "2e-5", "1e-3 1e-3 1e-3": "1e-5 1e-5 1e-5", 'armature="0.02"': 'armature="0.0002"'}

    def text(dry: float) -> str:
        made = model_text(kp=15.0, friction=dry)
        for old, new in changes.items() if weightless else ():
            made = made.replace(old, new)
        return made

    made = [record(text(x), seed, 21.0) for seed, x in enumerate(friction, start=1)]
    search = search_on(text(0.2), made)
    names = ("kp", "coulomb", "viscous")
    return search, search.improve(LoopFit(search.nominal).freed(at_both(*names)))


def at_both(*names: str) -> list[tuple[int, str]]:
    """Places of these parameters at both joints."""
    return [(j, name) for j in (0, 1) for name in names]


def search_on(text: str, recordings: Sequence[Recording], floor: float = 3e-4) -> LoopSearch:
    """Recordings beside a model, of which effects may be chosen; with a noise `floor` [rad]."""
    plant = MovedModel(load_model(mujoco.MjModel.from_xml_string(text)))
    data = windows_of(plant, recordings, [f"run {k}" for k in range(len(recordings))])
    point = nominal_point(plant)
    return LoopSearch(data, scales_of(data), point, np.full(data.joints, floor))


def weight_text(friction: float, armature: float, actuator: str) -> str:
    """One servo that turns a weight beside its axis."""
    return f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="horn">
<joint name="servo" axis="0 -1 0" frictionloss="{friction}" armature="{armature}" damping="0.02"
 solreffriction="0.01 1" solimpfriction="0.999 0.9999 0.001 0.5 2"/>
<inertial pos="0.16 0 0" mass="0.35" diaginertia="5e-4 5e-4 2e-4"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>"""
