"""The physics: MuJoCo steps the arm with its stops and friction; torque is measured on the link side.

A joint's sensor reads what the transmission passes on to the link: motor torque less friction, ripple and rotor
acceleration. The stops push on the link, beyond the sensor, so a joint pressed on its stop reads the pressing torque.
A motor is a mass of its own only if its transmission is elastic (`sim_bus.physics.transmission`); the model is then
rebuilt.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armlink.arm_file import ArmFile
from armlink.arrays import Array
from sim_bus.effects.state import Imperfections
from sim_bus.physics.inertials import ModelBodies
from sim_bus.physics.joint_torques import Cables, LateMotors, dry_friction, unevenness
from sim_bus.physics.mjcf import build_model
from sim_bus.physics.transmission import HARD_GEAR_STEP, Transmissions, rotor_inertia
from sim_bus.sim_section import sim_section

FRICTION_AT_DOF = int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)
BRAKE_SHARE = 3.0
"""Holding torque of the brake, in units of the maximum torque."""


class Plant:
    """Physics of the arm. All arrays (n,) in joint order, true angles [rad], torques [N·m]."""

    def __init__(self, arm: ArmFile, imperfections: Imperfections) -> None:
        """Build the arm at rest in its start position (default: mid-range). Raises BadInput."""
        self._arm, self._section, link = arm, sim_section(arm), arm.require_link()
        self.n = n = len(link.joints)
        self._attached = np.zeros(4)
        self._brake_torque = BRAKE_SHARE * np.array([joint.max_torque for joint in link.joints])
        self._braked = np.zeros(n, bool)
        self._servo = (np.zeros(n), np.zeros(n), np.zeros(n))
        self.torque_constant = np.ones(n)
        """Torque that each drive believes to make for one that it makes: its nominal by its true torque constant."""
        self.averages = False
        """Whether take_mean_torque() is asked after steps."""
        self._made, self._made_in = np.zeros(n), 0.0
        """Torque times time of the drives since it was asked last [N·m·s], and that time [s]."""
        self._lost, self._sag = np.zeros(n), np.zeros(n)
        self._cables: Cables | None = None
        self._build(Imperfections(arm.joint_names))
        self._joint_inertia = np.diag(self.inertia((self.lower + self.upper) / 2)).copy()
        start = (self.lower + self.upper) / 2 if self._section.start is None else np.array(self._section.start)
        self._enter(start, np.zeros(n), np.zeros(n))
        self.set_imperfections(imperfections)

    def _build(self, state: Imperfections) -> None:
        built = build_model(self._arm, state)
        self.model, names = built.model, self._arm.joint_names
        self.data = data = mujoco.MjData(self.model)
        self._joints = joints = [self.model.joint(name).id for name in names]
        self._dof: NDArray[np.intp] | slice = self.model.jnt_dofadr[joints]
        self._positions: Array = data.qpos
        self._velocities: Array = data.qvel
        self._accelerations: Array = data.qacc
        self._motor_torques: Array = data.actuator_force
        self._place_of_dof = np.full(self.model.nv, -1)
        self._place_of_dof[self._dof] = np.arange(self.n)
        if (self._dof == np.arange(self.n)).all():
            self._dof = slice(0, self.n)
        self.lower, self.upper = self.model.jnt_range[joints].T.copy()
        self._bodies = ModelBodies(self.model, list(built.bodies), built.payload_body)
        self._gravity: Array = self.model.opt.gravity.copy()
        self._armature = self.model.dof_armature[self._dof].copy()
        self._damping = self.model.dof_damping[self._dof].copy()
        self._springs = self.model.jnt_stiffness[self._joints].copy(), self.model.qpos_spring[self._dof].copy()
        self._gearing = state.gearing
        self._gears = Transmissions(self.model, names, state) if state.gearing else None

    def _enter(self, position: Array, velocity: Array, torque: Array) -> None:
        """Set the joints' motion; motors behind springs carry `torque`."""
        data = self.data
        data.qpos[self._dof], data.qvel[self._dof] = position, velocity
        if self._gears is not None:
            self._gears.settle(data.qpos, torque)
            self._gears.settle_speed(data.qvel)

    def place(self, joint: int, angle: float) -> None:
        """Put one joint at a true angle [rad], kept within its stops, at rest: as a hand turns it."""
        position, velocity = self.data.qpos[self._dof].copy(), self.data.qvel[self._dof].copy()
        position[joint], velocity[joint] = np.clip(angle, self.lower[joint], self.upper[joint]), 0.0
        self._enter(position, velocity, np.zeros(self.n))

    # ---- properties

    def set_imperfections(self, imperfections: Imperfections) -> None:
        """Apply masses, base, friction and transmissions of `imperfections`; the joints' motion is kept.

        Raises ValueError if they cannot be simulated.
        """
        rotors = rotor_inertia(self._arm.joint_names, imperfections, self._joint_inertia)
        if imperfections.gearing != self._gearing:
            position, moved = self.position, self.data.time > 0.0
            torque = self.link_torque if moved else self.gravity_torque(position)[0]
            motion = position, self.velocity, torque
            self._build(imperfections)
        else:
            motion = None
        if self._gears is not None:
            self._gears.configure(imperfections, rotors)
        if motion is not None:
            self._enter(*motion)
        self._imperfections = imperfections
        self._viscous = self._damping + imperfections.viscous
        self._rotor_inertia = np.maximum(self._armature + imperfections.rotor_inertia, rotors)
        self.step_time = self._section.step
        if self._gears is not None:
            finest = self._gears.step_time if imperfections.prompt_motors else HARD_GEAR_STEP
            self.step_time = min(self.step_time, self._gears.step_time, finest)
        self._has_rotors = bool(self._rotor_inertia.any())
        self._seat("armature", self._rotor_inertia)
        self._seat("damping", self._viscous)
        self.model.opt.gravity[:] = _tilted(imperfections.tilt).T @ self._gravity
        (own, own_rest), (added, rest) = self._springs, imperfections.spring.T
        self.model.jnt_stiffness[self._joints] = own + added
        self.model.qpos_spring[self._dof] = (own * own_rest + added * rest) / np.where(own + added > 0, own + added, 1)
        self._bodies.turn_frames(imperfections)
        self._bodies.weigh(self._imperfections, self._attached)
        self._cables = None
        if imperfections.cable.any():
            self._cables = Cables(imperfections, (self.lower + self.upper) / 2, self.position)
        self._has_uneven = bool(imperfections.uneven.any() or imperfections.leaning.any())
        slow = imperfections.cogging, imperfections.compliance
        self._changing = self._has_uneven or any(each.any() for each in slow) or self._cables is not None
        self._steady_friction = imperfections.steady_friction
        self._motors = None if imperfections.prompt_motors else LateMotors(imperfections, self.motor_torque)
        self._plain = self._steady_friction and self._motors is None and self._gears is None
        self._lost, self._uneven = np.zeros(self.n), np.zeros(self.n)
        self._passed_on: Array | None = None
        """Link torque half-way through the last step: a drive whose target stands still in it ends with less torque."""
        self.data.qfrc_applied[:] = 0.0
        self._set_friction()
        self.set_servo(*self._servo)
        mujoco.mj_forward(self.model, self.data)
        self._change()

    def attach_mass(self, mass: float, point: Array) -> None:
        """Attach a point mass [kg] at `point` of the last link's bar frame [m], in place of an earlier one."""
        self._attached = np.array([mass, *np.asarray(point, float)])
        self._bodies.weigh(self._imperfections, self._attached)
        mujoco.mj_forward(self.model, self.data)

    def detach_mass(self) -> None:
        self.attach_mass(0.0, np.zeros(3))

    def gravity_torque(self, q: Array) -> Array:
        """True holding torque ∂V/∂q at the angles `q` (K, n) → (K, n), with the attached mass."""
        scratch, q = mujoco.MjData(self.model), np.atleast_2d(np.asarray(q, float))
        torque = np.empty_like(q)
        for row, angles in enumerate(q):
            scratch.qpos[self._dof] = angles
            mujoco.mj_kinematics(self.model, scratch)
            mujoco.mj_comPos(self.model, scratch)
            mujoco.mj_rne(self.model, scratch, 0, scratch.qfrc_bias)
            torque[row] = scratch.qfrc_bias[self._dof]
        return torque

    def inertia(self, q: Array) -> Array:
        """Joint-space inertia matrix at the angles `q` (n,) → (n, n) [kg·m²]."""
        scratch, full = mujoco.MjData(self.model), np.empty((self.model.nv, self.model.nv))
        scratch.qpos[self._dof] = q
        mujoco.mj_forward(self.model, scratch)
        mujoco.mj_fullM(self.model, scratch, full)
        matrix: Array = full[self._dof][:, self._dof]
        return matrix

    # ---- state and steps

    @property
    def position(self) -> Array:
        """True joint angles [rad]."""
        return self._positions[self._dof].copy()

    @property
    def velocity(self) -> Array:
        """True joint velocities [rad/s]."""
        return self._velocities[self._dof].copy()

    @property
    def motor_position(self) -> Array:
        """Motor angles referred to the joints, which position sensors measure."""
        position = self._positions[self._dof] if self._gears is None else self._gears.shown(self._positions)
        return position + self._sag

    @property
    def motor_velocity(self) -> Array:
        return self.velocity if self._gears is None else self._gears.shown(self._velocities)

    @property
    def motor_torque(self) -> Array:
        return self._motor_torques.copy()

    @property
    def lateness(self) -> Array:
        """Delay of the motors' torque [s]."""
        return self._imperfections.actuator_delay + self._imperfections.actuator_lag

    @property
    def rotor_inertia(self) -> Array:
        """Inertia of motors behind elastic transmissions [kg·m²]; infinite for rigid ones."""
        return np.where(self._imperfections.soft, self._rotor_inertia, np.inf)

    @property
    def drive_torque(self) -> Array:
        """Motor torque estimated by the drive: current times nominal torque constant, but for `torque_constant`."""
        return self._motor_torques / self._imperfections.actuator_gain

    @property
    def link_torque(self) -> Array:
        """Torque that each transmission passes on to its link, as an ideal joint torque sensor measures it."""
        data, dof, gears = self.data, self._dof, self._gears
        if gears is not None:
            speed, acceleration = gears.turned(self._velocities), gears.turned(self._accelerations)
            made = self._motor_torques
            passed = made - self._viscous * speed - self._rotor_inertia * acceleration - self._lost
            return gears.on_links(data, made, passed + gears.friction(data, FRICTION_AT_DOF))
        torque: Array = self._motor_torques - self._viscous * self._velocities[dof]
        if self._has_rotors:
            torque -= self._rotor_inertia * self._accelerations[dof]
        if self._motors is not None:
            torque -= self._lost
        torque[self._friction_rows()] += data.efc_force[data.ne : data.ne + data.nf]
        return torque

    def set_servo(self, stiffness: Array, damping: Array, limit: Array) -> None:
        """Motor torque = clamp(drive − stiffness·q − damping·q̇, ±limit), at every step of the physics."""
        self._servo, state = (stiffness, damping, limit), self._imperfections
        gain, model = state.actuator_gain / self.torque_constant, self.model
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
        if self._changing:
            self._change()
        if start is end and self._plain and not self.averages:
            data.ctrl[:] = end
            mujoco.mj_step(model, data, count)
            return
        slope, gears = (end - start) / count, self._gears
        level, began = start + 0.5 * slope, self.motor_velocity if self.averages else 0.0
        for place in range(count):
            data.ctrl[:] = level if self._motors is None else self._asked(level, duration / count)
            if not self._steady_friction:
                self._set_friction()
            if gears is not None:
                data.qfrc_applied[:] = gears.forces(data, self._lost)
                data.qfrc_applied[self._dof] += self._pulled
            mujoco.mj_step(model, data)
            if place == count // 2 and self._has_uneven:
                self._passed_on = self.link_torque
            if self.averages:
                self._made += self._motor_torques * (duration / count)
            level = level + slope
        if self.averages:  # the integrator is implicit: a step's damping acts on the velocity at its end
            damped = model.actuator_biasprm[:, 2] * (self.motor_velocity - began)
            self._made += damped * (duration / count)
            self._made_in += duration

    def take_mean_torque(self) -> Array:
        """Mean of drive_torque (n,) [N·m] over the steps since it was asked last."""
        mean: Array = self._made / (max(self._made_in, 1e-12) * self._imperfections.actuator_gain)
        self._made[:], self._made_in = 0.0, 0.0
        return mean

    def _asked(self, level: Array, duration: float) -> Array:
        """Torque of delayed motors for the drive's demand; ripple is subtracted on the way to the link."""
        assert self._motors is not None
        stiffness, damping, limit = self._servo
        position = self.motor_position
        wanted = level - stiffness * position - damping * self.motor_velocity
        amplitude, cycles, phase = self._imperfections.ripple.T
        self._lost = amplitude * np.sin(cycles * position + phase)
        self.data.qfrc_applied[self._dof] = self._pulled - self._lost
        return self._motors.torque(np.clip(wanted, -limit, limit), duration)

    # ---- internals

    def _change(self) -> None:
        """Bring cables, sag and uneven friction up to date; once a step, as they change slowly."""
        position, torque = self.position, self.link_torque
        self._pulled = np.zeros(self.n) if self._cables is None else self._cables.torque(position)
        amplitude, cycles, phase = self._imperfections.cogging.T
        self._cogged = amplitude * np.sin(cycles * position + phase)
        self._pulled = self._pulled - self._cogged
        if self._gears is None:
            self.data.qfrc_applied[self._dof] = self._pulled - self._lost
        self._sag = self._imperfections.compliance * torque
        if self._has_uneven:
            load = torque if self._passed_on is None else self._passed_on
            self._uneven = unevenness(self._imperfections, position, self.velocity, load, self.data.time)
            self._set_friction()

    def _set_friction(self) -> None:
        """Set dry friction for the present velocity and load, or the brake's."""
        state = self._imperfections
        level = state.coulomb
        if not self._steady_friction:
            velocity = self.velocity if self._gears is None else self._gears.turned(self._velocities)
            level = dry_friction(state, velocity, self.link_torque, self._motor_torques)
        self._seat("frictionloss", np.where(self._braked, self._brake_torque, np.maximum(level + self._uneven, 0.0)))

    def _seat(self, quantity: str, values: Array) -> None:
        on_dofs = getattr(self.model, f"dof_{quantity}")
        if self._gears is None:
            on_dofs[self._dof] = values
        else:
            self._gears.seat(on_dofs, getattr(self.model, f"tendon_{quantity}"), values)

    def _friction_rows(self) -> Any:
        """Indices of the joints with a friction constraint, in the order of the constraints."""
        data = self.data
        if data.nf == self.n:
            return slice(0, self.n)
        return self._place_of_dof[data.efc_id[data.ne : data.ne + data.nf]]


def _tilted(angles: Array) -> Array:
    """Rotation of the base: about its x axis, then about its y axis [rad] → (3, 3)."""
    (cx, cy), (sx, sy) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rotation: Array = about_x @ about_y
    return rotation
