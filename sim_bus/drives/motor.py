"""A joint's motor as its drive sees it: readings, and the one law that drives without a sensor of torque follow.

Drive side and joint side differ by direction, gear and zero of the arm file. Torque is current times the drive's torque
constant: a drive makes `v` where the joint gets `τ = (v − offset) / gain`, with the gain and offset that the truth has
for the joint's torque reading, so that the reading `v = gain·τ + offset` is wrong in the same way as the command.
"""

import numpy as np

from armlink.arm_file import LinkJoint
from armlink.arrays import Array
from sim_bus.node.position_torque_loops import Loops
from sim_bus.physics.plant import Plant
from sim_bus.physics.sensors import JointSensors


class Readings:
    """Readings of all joints' motors at one time; arrays (n,), sampled once however many drives ask."""

    def __init__(self, plant: Plant, sensors: JointSensors) -> None:
        self._plant, self._sensors = plant, sensors
        self._time = -1.0
        self.position, self.velocity, self.torque, self.heating = (np.zeros(plant.n) for _ in range(4))
        """By the drive's encoder [rad] and [rad/s]; current times torque constant [N·m]; temperature rise [K]."""
        self._mean = np.zeros(plant.n)

    def step_ends(self) -> None:
        """A step of the arm has ended: a drive tells the mean of its many cycles within it, not the last one.

        A stiff drive whose target stands still for a step while the joint moves on makes less and less torque in it.
        """
        self._mean = self._plant.take_mean_torque()

    def at(self, time: float) -> "Readings":
        if time != self._time:
            plant, sensors = self._plant, self._sensors
            self._time = time
            self.position = sensors.position_counts(plant.motor_position) * sensors.position_step
            self.velocity = plant.motor_velocity / sensors.position_gain
            self.torque = sensors.torque(self._mean, time)
            if sensors.warms:
                self.heating = sensors.heating(time)
        return self


class Motor:
    """One joint's motor, in the units and the sense of its drive's output."""

    def __init__(
        self, joint: int, described: LinkJoint, loops: Loops, sensors: JointSensors, readings: Readings
    ) -> None:
        settings = described.settings
        self.joint, self.rated_torque = joint, described.rated_torque
        self.ratio: float = settings.direction * settings.gear
        """Turns of the drive's output for one of the joint, with sign."""
        self._zero: float = settings.zero
        self._loops, self._sensors, self._readings = loops, sensors, readings
        self._time = 0.0
        self.powered = False

    def pass_time(self, time: float) -> None:
        self._time = time

    @property
    def position(self) -> float:
        """Encoder reading [rad]."""
        return self._zero + self.ratio * self._value(self._readings.at(self._time).position)

    @property
    def velocity(self) -> float:
        return self.ratio * self._value(self._readings.at(self._time).velocity)

    @property
    def torque(self) -> float:
        """Current times torque constant [N·m]."""
        return self._value(self._readings.at(self._time).torque) / self.ratio if self.powered else 0.0

    @property
    def heating(self) -> float:
        """Rise of its temperature since power-on [K]."""
        return self._value(self._readings.at(self._time).heating)

    def impede(
        self, kp: float, kd: float, position: float, velocity: float, torque: float, limit: float = np.inf
    ) -> None:
        """Make `kp (position − q) + kd (velocity − dq) + torque` from now on, within ±limit [N·m], by its encoder."""
        ratio, sensors, joint = self.ratio, self._sensors, self.joint
        gain, offset = float(sensors.position_gain[joint]), float(sensors.position_offset[joint])
        turn = ratio / gain
        """Drive's reading = turn · true angle + what lies at angle 0."""
        at_zero = self._zero - turn * offset
        level = kp * (position - at_zero) + kd * velocity + torque
        self.powered = True
        self._loops.impede(joint, kp * turn * ratio, kd * turn * ratio, level * ratio, limit * abs(ratio))

    def pace(self, kd: float, velocity: float, torque: float, limit: float) -> None:
        """Make `kd (velocity − dq) + torque` within ±limit [N·m], with a velocity so near to its own that it does not
        saturate: a drive runs its loop many times in a step of the arm."""
        reach, now = limit / kd / 2, self.velocity
        self.impede(0.0, kd, 0.0, max(now - reach, min(now + reach, velocity)), torque, limit)

    @property
    def tuned(self) -> tuple[float, float, float]:
        """Stiffness, damping and integral gain of a position loop tuned for this joint, at the drive's output."""
        stiffness, damping, integral = self._loops.tuned(self.joint)
        square = self.ratio**2
        return stiffness / square, damping / square, integral / square

    def free(self) -> None:
        if self.powered:
            self.powered = False
            self._loops.release(self.joint)

    def _value(self, values: Array) -> float:
        return float(values[self.joint])
