"""Gains of position controllers that the model lacks and the user knows, as they stand beside a table."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armlink.errors import BadInput
from gcomp.arrays import Array


@dataclass(frozen=True, eq=False)
class KnownGains:
    """Gains by joint, (n,) each; one value for all is (1,)."""

    kp: Array
    """[N·m/rad]"""
    kd: Array
    """[N·m·s/rad]"""

    def of_joints(self, count: int) -> "KnownGains":
        """The same for so many joints. Raises BadInput where there are values for another number."""
        for name, values in (("kp", self.kp), ("kd", self.kd)):
            if len(values) not in (1, count):
                raise BadInput(
                    f"--gains {name}: {len(values)} values for {count} joints: give one value, or one for each joint"
                )
        return replace(self, **{name: np.resize(x, count) for name, x in (("kp", self.kp), ("kd", self.kd))})


def parse_known_gains(text: str) -> KnownGains | None:
    """Read `kp=20,kd=1.5` or `kp=20;20;30,kd=1;1;1.5`; None for an empty text. Raises BadInput."""
    if not text:
        return None
    found: dict[str, Array] = {}
    for part in text.split(","):
        name, _, values = part.strip().partition("=")
        try:
            numbers = np.array([float(value) for value in values.split(";")])
        except ValueError:
            numbers = np.array([np.nan])
        positive = bool(np.all(np.isfinite(numbers) & (numbers >= 0.0))) and (name != "kp" or bool(np.all(numbers > 0)))
        if name not in ("kp", "kd") or name in found or not positive:
            raise BadInput(f"--gains {part.strip()}: expected kp=VALUE,kd=VALUE in N·m/rad and N·m·s/rad, or kp=A;B;…")
        found[name] = numbers
    if "kp" not in found:
        raise BadInput(f"--gains {text}: kp is missing: give kp=VALUE,kd=VALUE")
    return KnownGains(found["kp"], found.get("kd", np.zeros(1)))


def put_gains(spec: Any, joints: Sequence[int], gains: KnownGains) -> None:
    """Give joints of a compiled `mujoco.MjSpec` position actuators with these gains in place of what drives them."""
    import mujoco

    for j, joint in enumerate(joints):
        name = spec.joints[joint].name
        old = [a for a in spec.actuators if a.target == name and a.trntype == mujoco.mjtTrn.mjTRN_JOINT]
        limits = [list(a.forcerange) for a in old if a.forcerange[0] < a.forcerange[1]]
        called = old[0].name if old else f"position_{name}"
        for actuator in old:
            spec.delete(actuator)
        made = spec.add_actuator(name=called, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.set_to_position(kp=float(gains.kp[j]), kv=float(gains.kd[j]))
        if limits:
            made.forcelimited, made.forcerange = 1, limits[0]
