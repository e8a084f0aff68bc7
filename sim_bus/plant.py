"""The physics: MuJoCo steps the arm with its stops and friction; torque is measured on the link side.

A joint's sensor reads what the transmission passes on to the link: motor torque less friction, ripple and rotor
acceleration. The stops push on the link, beyond the sensor, so a joint pressed on its stop reads the pressing torque.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armlink.armfile import ArmFile
from sim_bus.effects.state import Imperfections
from sim_bus.inertials import Inertials
from sim_bus.mjcf import build_model
from sim_bus.motors import LateMotors
from sim_bus.section import sim_section

Array = NDArray[np.float64]
BRAKE_SHARE = 3.0
"""What the holding brake holds, in maximal torques."""


class Plant:
    """The arm as a physical thing. All arrays (n,) in joint order, true angles [rad], torques [N·m]."""

    def __init__(self, arm: ArmFile, imperfections: Imperfections) -> None:
        """Build it at rest in its start position (mid-range by default). Raises BadInput."""
        section, link = sim_section(arm), arm.require_link()
        built = build_model(arm)
        self.model, self.n = built.model, len(built.bodies)
        self.data = mujoco.MjData(self.model)
        self._joints = joints = [self.model.joint(name).id for name in arm.joint_names]
        self._qpos: NDArray[np.intp] | slice = self.model.jnt_qposadr[joints]
        self._dof: NDArray[np.intp] | slice = self.model.jnt_dofadr[joints]
        data = self.data
        self._positions: Array = data.qpos
        self._velocities: Array = data.qvel
        self._accelerations: Array = data.qacc
        self._motor_torques: Array = data.qfrc_actuator
        self._place_of_dof = np.full(self.model.nv, -1)
        self._place_of_dof[self._dof] = np.arange(self.n)
        if (self._dof == np.arange(self.n)).all():
            self._dof = slice(0, self.n)
        if (self._qpos == np.arange(self.n)).all():
            self._qpos = slice(0, self.n)
        self.lower, self.upper = self.model.jnt_range[joints].T.copy()
        self._inertials = Inertials(self.model, list(built.bodies), built.payload_body)
        self._gravity: Array = self.model.opt.gravity.copy()
        self._armature = self.model.dof_armature[self._dof].copy()
        self._damping = self.model.dof_damping[self._dof].copy()
        self._attached = np.zeros(4)
        self._brake_torque = BRAKE_SHARE * np.array([joint.max_torque for joint in link.joints])
        self._braked = np.zeros(self.n, bool)
        self._servo = (np.zeros(self.n), np.zeros(self.n), np.zeros(self.n))
        self.step_time = section.step
        start = (self.lower + self.upper) / 2 if section.start is None else np.array(section.start)
        self.data.qpos[self._qpos] = start
        self.set_imperfections(imperfections)

    # ---- what it is

    def set_imperfections(self, imperfections: Imperfections) -> None:
        """Take over masses, base and friction of `imperfections`; state and motion stay."""
        self._imperfections = imperfections
        self._viscous = self._damping + imperfections.viscous
        self._rotor_inertia = self._armature + imperfections.rotor_inertia
        self._has_rotors = bool(self._rotor_inertia.any())
        self.model.dof_armature[self._dof] = self._rotor_inertia
        self.model.dof_damping[self._dof] = self._viscous
        self.model.opt.gravity[:] = _tilt(imperfections.tilt).T @ self._gravity
        self.model.jnt_stiffness[self._joints] = imperfections.spring[:, 0]
        self.model.qpos_spring[self._qpos] = imperfections.spring[:, 1]
        self._inertials.apply(self._imperfections, self._attached)
        self._steady_friction = imperfections.steady_friction
        self._motors = None if imperfections.prompt_motors else LateMotors(imperfections, self.motor_torque)
        self._plain = self._steady_friction and self._motors is None
        self.data.qfrc_applied[:] = 0.0
        self._set_friction()
        self.set_servo(*self._servo)
        mujoco.mj_forward(self.model, self.data)

    def attach_mass(self, mass: float, point: Array) -> None:
        """Bolt a point mass [kg] on at `point` of the last link's bar frame [m]; it replaces an earlier one."""
        self._attached = np.array([mass, *np.asarray(point, float)])
        self._inertials.apply(self._imperfections, self._attached)
        mujoco.mj_forward(self.model, self.data)

    def detach_mass(self) -> None:
        """Take off what attach_mass put on."""
        self.attach_mass(0.0, np.zeros(3))

    def gravity_torque(self, q: Array) -> Array:
        """True holding torque ∂V/∂q at the angles `q` (K, n) → (K, n), everything attached included."""
        scratch, q = mujoco.MjData(self.model), np.atleast_2d(np.asarray(q, float))
        torque = np.empty_like(q)
        for row, angles in enumerate(q):
            scratch.qpos[self._qpos] = angles
            mujoco.mj_kinematics(self.model, scratch)
            mujoco.mj_comPos(self.model, scratch)
            mujoco.mj_rne(self.model, scratch, 0, scratch.qfrc_bias)
            torque[row] = scratch.qfrc_bias[self._dof]
        return torque

    def inertia(self, q: Array) -> Array:
        """Joint-space inertia matrix at the angles `q` (n,) → (n, n) [kg·m²]."""
        scratch, full = mujoco.MjData(self.model), np.empty((self.model.nv, self.model.nv))
        scratch.qpos[self._qpos] = q
        mujoco.mj_forward(self.model, scratch)
        mujoco.mj_fullM(self.model, scratch, full)
        inertia: Array = full[self._dof][:, self._dof]
        return inertia

    # ---- what it does

    @property
    def position(self) -> Array:
        """True joint angles [rad]."""
        return self._positions[self._qpos].copy()

    @property
    def velocity(self) -> Array:
        """True joint velocities [rad/s]."""
        return self._velocities[self._dof].copy()

    @property
    def motor_torque(self) -> Array:
        """Torque that each motor makes."""
        return self._motor_torques[self._dof].copy()

    @property
    def drive_torque(self) -> Array:
        """Torque that the drive believes its motor makes: current times nominal torque constant."""
        return self.motor_torque / self._imperfections.actuator_gain

    @property
    def link_torque(self) -> Array:
        """Torque that each transmission passes on to its link: what an ideal joint torque sensor reads."""
        data, dof = self.data, self._dof
        torque: Array = self._motor_torques[dof] - self._viscous * self._velocities[dof]
        if self._has_rotors:
            torque -= self._rotor_inertia * self._accelerations[dof]
        if self._motors is not None:
            torque += data.qfrc_applied[dof]
        torque[self._friction_rows()] += data.efc_force[data.ne : data.ne + data.nf]
        return torque

    def set_servo(self, stiffness: Array, damping: Array, limit: Array) -> None:
        """Motor torque = clamp(drive − stiffness·q − damping·q̇, ±limit), at every step of the physics."""
        self._servo, state = (stiffness, damping, limit), self._imperfections
        gain, model = state.actuator_gain, self.model
        limit = gain * np.minimum(limit, state.actuator_saturation)
        fed_back = gain if self._motors is None else np.zeros(self.n)
        model.actuator_gainprm[:, 0] = gain
        model.actuator_biasprm[:, 1] = -fed_back * stiffness
        model.actuator_biasprm[:, 2] = -fed_back * damping
        model.actuator_forcerange[:, 0] = -limit
        model.actuator_forcerange[:, 1] = limit

    def set_brakes(self, closed: NDArray[np.bool_]) -> None:
        """Close or open the holding brakes; they act before the torque sensor, as friction does."""
        self._braked = np.array(closed, bool)
        self._set_friction()
        mujoco.mj_forward(self.model, self.data)

    def step(self, start: Array, end: Array, duration: float) -> None:
        """Run for `duration` [s] while the motors' `drive` torque goes linearly from `start` to `end`."""
        count = max(1, int(np.ceil(duration / self.step_time - 1e-9)))
        model, data = self.model, self.data
        model.opt.timestep = duration / count
        if start is end and self._plain:
            data.ctrl[:] = end
            mujoco.mj_step(model, data, count)
            return
        slope = (end - start) / count
        level = start + 0.5 * slope
        for _ in range(count):
            data.ctrl[:] = level if self._motors is None else self._asked(level, duration / count)
            if not self._steady_friction:
                self._set_friction()
            mujoco.mj_step(model, data)
            level = level + slope

    def _asked(self, level: Array, duration: float) -> Array:
        """What late motors make of the drive's torque; the ripple is taken off on the way to the link."""
        assert self._motors is not None
        stiffness, damping, limit = self._servo
        wanted = level - stiffness * self.position - damping * self.velocity
        amplitude, cycles, phase = self._imperfections.ripple.T
        self.data.qfrc_applied[self._dof] = -amplitude * np.sin(cycles * self.position + phase)
        return self._motors.torque(np.clip(wanted, -limit, limit), duration)

    # ---- inside

    def _set_friction(self) -> None:
        """Level of dry friction at the present velocity and load, or the brake's."""
        state = self._imperfections
        level = state.coulomb
        if not state.steady_friction:
            velocity, load = self.velocity, self.link_torque
            level = level + state.breakaway * np.exp(-((velocity / state.stribeck_velocity) ** 2))
            level = level + state.load_friction * np.abs(load)
            resting = np.abs(velocity) < 1e-4
            heading = np.where(resting, np.sign(self.motor_torque - load), np.sign(velocity))
            level = level * (1.0 + state.asymmetry * heading)
        self.model.dof_frictionloss[self._dof] = np.where(self._braked, self._brake_torque, np.maximum(level, 0.0))

    def _friction_rows(self) -> Any:
        """Places of the joints that have a friction constraint, in the order of the constraints."""
        data = self.data
        if data.nf == self.n:
            return slice(0, self.n)
        return self._place_of_dof[data.efc_id[data.ne : data.ne + data.nf]]


def _tilt(angles: Array) -> Array:
    """Rotation of the base: about its x axis, then about its y axis (3, 3)."""
    (cx, cy), (sx, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rotation: Array = about_x @ about_y
    return rotation
