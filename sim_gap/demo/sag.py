"""How far joints sag that are held by weak gains and gravity fed forward: nominal model against records."""

from contextlib import closing
from dataclasses import dataclass

import numpy as np

from armlink.drives.orders import Mode
from armlink.link.types import Command, Sample
from armlink.loop.driver import ArmDriver
from calib.plan.types import SweepPlan
from gcomp.arrays import Array
from gcomp.gravity.batch import GravityModel
from sim_gap.demo.bench import Bench
from sim_gap.demo.motion import travel
from sim_gap.demo.script import SAG_POSES, SAG_SECONDS, WEAK_SHARE


@dataclass(frozen=True, eq=False)
class Sag:
    """Mean absolute deflection from the poses held (n,) [rad]."""

    nominal: Array
    """With the model file's masses and torque as the drives take it."""
    calibrated: Array
    """With the records."""
    poses: int


class WeakHold:
    """Torque control: gravity fed forward, and a tenth of the gains about a pose; picklable."""

    def __init__(self, model: GravityModel, zero: Array, pose: Array, kp: Array, kd: Array) -> None:
        """`pose` and `zero` (n,) [rad] are readings and what is added to them."""
        self._model, self._zero, self._pose, self._kp, self._kd = model, zero, pose, kp, kd
        self._position = pose.copy()

    def command(self, sample: Sample) -> Command:
        """Torque for the newest sample."""
        np.copyto(self._position, sample.position, where=np.isfinite(sample.position))
        speed = np.nan_to_num(sample.velocity)
        torque = self._model.one(self._position + self._zero) + self._kp * (self._pose - self._position)
        return Command(np.full(len(torque), Mode.TORQUE, np.int8), torque - self._kd * speed, self._position.copy())


def sag_poses(plan: SweepPlan) -> Array:
    """Poses to hold (SAG_POSES, n) [rad]: where creeps of the joints next to the base begin; home lies between them."""
    return np.array([sweep.rest for sweep in plan.sweeps[::-2][:SAG_POSES]])


def mean_sag(bench: Bench, plan: SweepPlan, beta: Array, zero: Array) -> Array:
    """Mean deflection (n,) [rad] with the mass moments beta (2n,) [kg·m] and the zeros (n,) [rad] of position readings.

    The joints hold at the end. Raises Refused where a joint runs away from its pose, BusFault.
    """
    link, home = bench.link, np.array(plan.scout[0])
    drives = [joint.settings for joint in bench.arm.require_link().joints]
    kp, kd = np.array([WEAK_SHARE * each.kp for each in drives]), np.array([each.kd for each in drives])
    model, away = GravityModel(bench.described, beta), []
    for pose in sag_poses(plan):
        travel(bench, link.position_sent, home)
        travel(bench, home, pose)
        seen = _hold(link, WeakHold(model, zero, pose, kp, kd))
        away.append(np.abs(np.nanmean(seen, axis=0) - pose))
        link.cycle(Command.hold(np.where(np.isfinite(seen[-1]), seen[-1], pose)))
    return np.asarray(np.mean(away, axis=0))


def _hold(link: ArmDriver, controller: WeakHold) -> Array:
    """Positions (K, n) [rad] of the last half second."""
    seen = []
    with closing(link.run(controller)) as samples:
        for sample in samples:
            seen.append(sample.position)
            if len(seen) >= SAG_SECONDS * link.rate:
                break
    return np.array(seen[-round(0.5 * link.rate) :])
