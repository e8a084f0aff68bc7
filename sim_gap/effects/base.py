"""A base that does not stand as the model says: gravity comes from another direction."""

import numpy as np

from sim_gap.effects.registry import Columns, Effect, Layout, Parameter, Shape
from sim_gap.model.rigid_body import Array
from sim_gap.residuals.preprocess import Signals


class Tilt(Effect):
    """The base turned about two axes across gravity (the base's x and y where gravity is along z), small angles."""

    id = "base.tilt"
    parameters = (Parameter("angle_1", "rad"), Parameter("angle_2", "rad"))
    whole_arm = True

    def columns(self, signals: Signals, layout: Layout, place: int, shape: Shape) -> Columns:
        gravity = signals.arm.gravity
        turned = np.stack([-np.cross(axis, gravity) for axis in across(gravity)], axis=-1)
        columns = signals.gravity_columns @ turned
        return {(layout.against_model, joint): columns[:, joint] for joint in range(signals.n)}

    def spread(self, signals: Signals, place: int) -> Array:
        return np.full(2, 0.3)


def across(gravity: Array) -> Array:
    """The two base axes most nearly perpendicular to gravity, (2, 3)."""
    order = np.sort(np.argsort(np.abs(gravity), kind="stable")[:2])
    return np.eye(3)[order]


EFFECTS: tuple[Effect, ...] = (Tilt(),)
