"""Motors coupled to two joints, in MuJoCo a fixed tendon with inertia, damping and friction loss."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sim_gap.model.load import SimModel
from sim_gap.search.estimate import Estimate
from sim_gap.search.term import Term


@dataclass(frozen=True)
class CoupledMotor:
    """A motor that turns by q_joint + lever·q_other and so loads both joints."""

    joint: str
    other: str
    lever: float
    inertia: float
    """[kg·m²]."""
    coulomb: float
    """[N·m]."""
    viscous: float
    """[N·m·s/rad]."""


def coupled_motors(
    sim: SimModel, estimate: Estimate | None, chosen: Sequence[Term] | None = None
) -> list[CoupledMotor]:
    """Motors coupled to two joints, of an estimate or of some of its terms."""
    every = () if estimate is None else estimate.terms if chosen is None else chosen
    terms = [term for term in every if term.effect == "transmission.coupling"]
    names = sim.arm.names
    return [
        CoupledMotor(names[t.place], names[int(t.shape[0]) - 1], t.shape[1], *estimate.of(t).tolist())
        for t in terms
        if estimate is not None
    ]


def add_to(spec: Any, motors: Sequence[CoupledMotor]) -> None:
    """Add the motors to a `mujoco.MjSpec`."""
    for number, motor in enumerate(motors, start=1):
        tendon = spec.add_tendon(name=f"motor_{number}_of_{motor.joint}_and_{motor.other}")
        tendon.wrap_joint(motor.joint, 1.0)
        tendon.wrap_joint(motor.other, motor.lever)
        tendon.armature, tendon.frictionloss = motor.inertia, motor.coulomb
        tendon.damping[0] = motor.viscous
