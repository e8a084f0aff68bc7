"""Collisions of the arm with itself or its surroundings, by MuJoCo's contacts on the arm file's model."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from armlink.arm_file import ArmFile
from armlink.errors import BadInput, Refused
from armlink.model_file import Beside, compile_model, read_model
from calib.arm.sweep_section import ParkedArm, sweep_section
from calib.plan.types import SCOUT_TITLE, Sweep, SweepPlan
from gcomp.arrays import Array, Mask

POINTS = 15
"""Poses checked between two poses of a plan: 0.1 rad apart if a joint moves 1.5 rad; a choice."""
DEPTH = 0.0005
"""Overlap from which bodies count as touching [m]; a choice, below the accuracy of collision meshes."""
PARKED = "parked "
"""Prefix of the body names of an arm that is parked beside this one, where it has a model of its own."""
TO_THE_PLAN = "on the way from its present pose to the first pose"
"""Description of the way on which a plan is reached."""
Pair = tuple[str, str]


class Collided(Refused):
    """A plan leads through a contact."""


@dataclass(frozen=True, eq=False)
class Contact:
    bodies: Pair
    depth: float
    """[m]"""


class Geometry:
    """The bodies of the arm file's model, and of arms parked beside it (`sweep.beside`).

    Overlaps that the model has at every pose, and those of a link with what carries it, do not count as collisions.
    """

    def __init__(self, arm_file: ArmFile) -> None:
        """Compile the model; raises BadInput if it cannot be used."""
        import mujoco

        from calib.arm.kinematics import gcomp_arm

        assert arm_file.model_path is not None
        self._mujoco = mujoco
        kinematics = gcomp_arm(arm_file)  # checks the chain, with errors in terms of the arm file
        self.left_out = read_model(arm_file.model_path).left_out
        parked = sweep_section(arm_file).beside
        folder = arm_file.path.parent
        beside = [Beside(folder / each.model, each.at, each.turned, PARKED) for each in parked if each.model]
        self.model = compile_model(arm_file.model_path, beside, arm_file.kinematics.locked)
        self.data = mujoco.MjData(self.model)
        for each in parked:
            self._park(arm_file, each, kinematics.names)
        self._places = [int(self.model.joint(name).qposadr[0]) for name in kinematics.names]
        self._own = np.zeros((self.model.nbody, self.model.nbody), dtype=bool)
        poses = np.random.default_rng(0).uniform(kinematics.lower, kinematics.upper, (12, kinematics.n))
        always = np.ones_like(self._own)
        for pose in poses:
            bodies, _ = self._overlaps(pose)
            at_this = np.zeros_like(always)
            at_this[bodies[:, 0], bodies[:, 1]] = True
            always &= at_this
        carrier = self.model.body_parentid[1:]
        pairs = np.sort(np.column_stack([np.arange(1, self.model.nbody), carrier])[carrier > 0], axis=1)
        always[pairs[:, 0], pairs[:, 1]] = True  # MuJoCo tries a fixed base against the link that it carries
        self._own = always

    def _park(self, arm_file: ArmFile, parked: ParkedArm, moving: tuple[str, ...]) -> None:
        """Bring the joints of an arm that is parked to their angles; raises BadInput for a joint that it has not."""
        for name, angle in parked.pose.items():
            known = f"{PARKED}{name}" if parked.model else name
            place = self._mujoco.mj_name2id(self.model, self._mujoco.mjtObj.mjOBJ_JOINT, known)
            if place < 0 or known in moving:
                what = (
                    "is moved by a drive of this arm"
                    if known in moving
                    else f"is not in {parked.model or arm_file.kinematics.model}"
                )
                raise BadInput(
                    f"{arm_file.path}: key sweep.beside: pose: joint {name!r} {what}: give only joints of other "
                    "arms, which stay at rest"
                )
            self.data.qpos[self.model.jnt_qposadr[place]] = angle

    def contacts(self, pose: Array) -> list[Contact]:
        """Collisions at a pose (n,) [rad], deepest first."""
        found: dict[Pair, float] = {}
        for (first, second), depth in zip(*self._overlaps(pose), strict=True):
            pair = (self._name(int(first)), self._name(int(second)))
            found[pair] = max(found.get(pair, 0.0), float(depth))
        return sorted((Contact(pair, depth) for pair, depth in found.items()), key=lambda each: -each.depth)

    def free(self, poses: Array) -> Mask:
        """Poses (K, n) [rad] without collision, as a mask (K,)."""
        return np.array([len(self._overlaps(pose)[1]) == 0 for pose in poses], dtype=bool)

    def _overlaps(self, pose: Array) -> tuple[npt.NDArray[np.intp], Array]:
        """Pairs of bodies that overlap (m, 2), lower id first, and by how much (m,) [m]."""
        data, model = self.data, self.model
        data.qpos[self._places] = pose
        self._mujoco.mj_kinematics(model, data)
        self._mujoco.mj_comPos(model, data)
        self._mujoco.mj_collision(model, data)
        if data.ncon == 0:  # at most of the many poses that a plan looks at
            return np.empty((0, 2), dtype=np.intp), np.empty(0)
        bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        counts = (data.contact.dist < -DEPTH) & ~self._own[bodies[:, 0], bodies[:, 1]]
        return bodies[counts], -data.contact.dist[counts]

    def _name(self, body: int) -> str:
        return "the surroundings" if body == 0 else str(self.model.body(body).name or f"body {body}")


def check_plan(arm_file: ArmFile, plan: SweepPlan, here: Array | None = None) -> str:
    """Check all poses along a plan, and on the way to it from `here` (n,) [rad], where that is known.

    Raises Collided naming bodies, sweep and pose. Returns a sentence on the check.
    """
    if arm_file.model_path is None:
        return "collisions are not checked: the arm file has no kinematics.model with geometry"
    geometry = Geometry(arm_file)
    if geometry.model.ngeom == 0:
        return f"collisions are not checked: {geometry.left_out or 'the model has no geometry'}"
    count = _require_free(arm_file, geometry, poses_along(plan, here))
    without = f", without {geometry.left_out}" if geometry.left_out else ""
    return f"no collision at {count} poses along the way{without}"


def check_creeps(arm_file: ArmFile, geometry: Geometry, plan: SweepPlan, here: Array) -> None:
    """Check every creep of a plan, and the way to it from the home pose, which is reached from `here` (n,) [rad].

    Raises Collided naming bodies, sweep and pose.
    """
    home = np.array(plan.scout[0])
    _require_free(arm_file, geometry, _between(here, home, TO_THE_PLAN))
    for sweep in plan.sweeps:
        begin, end = sweep_ends(sweep)
        for start, goal, place in ((home, begin, "on the way to sweep"), (begin, end, "in sweep")):
            _require_free(arm_file, geometry, _between(start, goal, f"{place} {sweep.name}"))


def _require_free(arm_file: ArmFile, geometry: Geometry, places: Iterable[tuple[str, Array]]) -> int:
    """How many poses (n,) [rad], each with its description, were looked at; raises Collided at the first contact."""
    count = 0
    for place, pose in places:
        count += 1
        touching = geometry.contacts(pose)
        if touching:
            first, second = touching[0].bodies
            raise Collided(
                f"{arm_file.name}: {first} would touch {second} {place}, {touching[0].depth * 1000:.1f} mm deep, at"
                f" {' '.join(f'{angle:.3f}' for angle in pose)} rad: narrow lower and upper of these joints in the arm"
                " file, or clear the workspace"
            )
    return count


def clear_way(
    arm_file: ArmFile, geometry: Geometry | None, ways: Sequence[Sequence[Array]], place: str
) -> Sequence[Array]:
    """The first of some ways by poses (n,) [rad] on which nothing touches beyond their common first pose, at which the
    arm stands already; without geometry the first. Raises Collided, as check_plan, for the first where all touch."""
    found = list[Collided]()
    for way in ways:
        try:
            if geometry is not None:
                for leg in pairwise(way):
                    _require_free(arm_file, geometry, _between(*leg, place))
            return way
        except Collided as collided:
            found.append(collided)
    raise found[0]


def poses_along(plan: SweepPlan, here: Array | None = None) -> Iterator[tuple[str, Array]]:
    """(Description, pose (n,) [rad]) of all motion of a plan, straight from one pose to the next, the first from `here`
    (n,) [rad]."""
    for number, scouted in enumerate(plan.scout, start=1):
        goal, first = np.array(scouted), number == 1 and here is not None
        yield from _between(here, goal, TO_THE_PLAN if first else f"on the way to pose {number} of the {SCOUT_TITLE}")
        here = goal
    for sweep in plan.sweeps:
        begin, end = sweep_ends(sweep)
        yield from _between(here, begin, f"on the way to sweep {sweep.name}")
        yield from _between(begin, end, f"in sweep {sweep.name}")
        here = begin


def sweep_ends(sweep: Sweep) -> tuple[Array, Array]:
    """First and last pose (n,) [rad] of a sweep."""
    begin = np.array(sweep.rest)
    end = begin.copy()
    begin[sweep.joint], end[sweep.joint] = sweep.steps[0], sweep.steps[-1]
    return begin, end


def _between(start: Array | None, goal: Array, place: str) -> Iterator[tuple[str, Array]]:
    if start is None:
        yield place, goal
        return
    for pose in straight_way(start, goal)[1:]:
        yield place, pose


def straight_way(begin: Array, end: Array) -> Array:
    """Poses (…, POINTS + 1, n) [rad] from one pose to another, ends included (…, n)."""
    shares = np.linspace(0, 1, POINTS + 1)[:, None]
    return begin[..., None, :] + shares * (end - begin)[..., None, :]
