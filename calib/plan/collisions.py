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
from calib.plan.types import APPROACH, SCOUT_TITLE, Sweep, SweepPlan
from gcomp.arrays import Array, Mask

DEPTH = 0.0005
"""Overlap from which bodies count as touching [m]; a choice, below the accuracy of collision meshes."""
PARTING = 1 / 15
"""Share of a way by which bodies that touch where the arm stands must have parted; a choice."""
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
        self._pairs = self._tried_pairs()
        levers = self._levers_of_shapes([self.model.joint(name).id for name in kinematics.names])[self._pairs]
        self._levers = np.nansum(levers, axis=0) * np.isnan(levers).any(axis=0)
        """(P, n) [m], of the joints that move only one shape of a pair."""
        radius = np.where(self.model.geom_rbound > 0, self.model.geom_rbound, np.inf)  # 0 for planes
        self._radii = radius[self._pairs].sum(axis=0)

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

    def way(self, begin: Array, end: Array, *, standing: bool = False) -> Iterator[tuple[Array, list[Contact]]]:
        """Poses (n,) [rad] on the straight way between two, both included, with the collisions at each, deepest first.

        Between two poses without collision no bodies overlap by more than 2 DEPTH: the way goes on by as much as brings
        no two shapes together that are apart (conservative advancement), at least by what moves them 2 DEPTH. An arm
        `standing` at the first pose may leave bodies that it touches there.
        """
        begun = self.contacts(begin)
        left = [each.bodies for each in begun] if standing else []
        travel, pose, share = self._levers @ np.abs(end - begin), begin, 0.0
        may_meet = travel > np.maximum(self._sphere_gaps(self._pairs, self._radii), 0.0)
        pairs, travel, radii = self._pairs[:, may_meet], travel[may_meet], self._radii[may_meet]
        gap = np.full(len(travel), -np.inf)
        while True:
            gap = np.maximum(gap, self._sphere_gaps(pairs, radii))
            step = self._clear_share(pairs, travel, gap, 1.0 - share)
            touching = self.contacts(pose) if begun or gap.min(initial=np.inf) <= 0 else []
            yield pose, [each for each in touching if share > PARTING or each.bodies not in left]
            if share == 1.0:
                return
            share, gap = min(share + step, 1.0), gap - step * travel
            pose = begin + share * (end - begin)
            self._bring(pose)

    def _clear_share(self, pairs: npt.NDArray[np.intp], travel: Array, gap: Array, rest: float) -> float:
        """Share of a way, up to its `rest`, on which none of some pairs of shapes (2, P) comes together that is apart
        at the present pose.

        `travel` (P,) [m] is how far they move at most against each other on the whole way, `gap` (P,) [m] a lower bound
        of the distance between them, which becomes the distance where it counts.
        """
        if not len(gap):
            return rest
        clear, exact = np.maximum(gap + DEPTH, 2 * DEPTH) / travel, set[int]()
        while clear[nearest := int(clear.argmin())] < rest and nearest not in exact:
            first, second = pairs[:, nearest]
            gap[nearest] = self._mujoco.mj_geomDistance(self.model, self.data, first, second, travel[nearest], None)
            clear[nearest] = max(gap[nearest] + DEPTH, 2 * DEPTH) / travel[nearest]
            exact.add(nearest)
        return min(float(clear[nearest]), rest)

    def _sphere_gaps(self, pairs: npt.NDArray[np.intp], radii: Array) -> Array:
        """Distances (P,) [m] between the spheres around pairs of shapes (2, P), whose radii together are `radii`."""
        apart = self.data.geom_xpos[pairs[0]] - self.data.geom_xpos[pairs[1]]
        return np.asarray(np.sqrt(np.einsum("pk,pk->p", apart, apart)) - radii)

    def _levers_of_shapes(self, joints: list[int]) -> Array:
        """Largest distances (shapes, n) [m] at any pose of a shape's points from the axes of joints, base to tip; NaN
        for joints that do not move it."""
        model, data = self.model, self.data
        moves = np.zeros((model.nbody, len(joints)), dtype=bool)
        for body in range(1, model.nbody):
            moves[body] = moves[model.body_parentid[body]] | (model.jnt_bodyid[joints] == body)
        moves = moves[model.geom_bodyid]
        levers, place, beyond = np.full(moves.shape, np.nan), data.geom_xpos.copy(), model.geom_rbound.copy()
        for number, joint in reversed(list(enumerate(joints))):  # from the shape along the links
            moved, anchor = moves[:, number], data.xanchor[joint]
            away = place[moved] - anchor
            levers[moved, number] = np.linalg.norm(np.cross(data.xaxis[joint], away), axis=1) + beyond[moved]
            beyond[moved] += np.linalg.norm(away, axis=1)
            place[moved] = anchor
        return levers

    def _tried_pairs(self) -> npt.NDArray[np.intp]:
        """Pairs of shapes (2, P) whose overlap is a collision, by MuJoCo's own rules and those of this class."""
        model = self.model
        first, second = pairs = np.array(np.triu_indices(model.ngeom, 1))
        low, high = bodies = np.sort(model.geom_bodyid[pairs], axis=0)
        rigid = model.body_weldid
        (one, other), (carrier, of_other) = rigid[bodies], rigid[model.body_parentid[rigid[bodies]]]
        tried = (model.geom_contype[first] & model.geom_conaffinity[second]) != 0
        tried |= (model.geom_contype[second] & model.geom_conaffinity[first]) != 0
        tried &= ~np.isin((low << 16) + high, model.exclude_signature)
        if not model.opt.disableflags & self._mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
            tried &= (one == 0) | (other == 0) | (one != of_other) & (other != carrier)
        for pair in zip(model.pair_geom1, model.pair_geom2, strict=True):
            tried |= (first == min(pair)) & (second == max(pair))
        return np.asarray(pairs[:, tried & ~self._own[low, high]])

    def _overlaps(self, pose: Array) -> tuple[npt.NDArray[np.intp], Array]:
        """Pairs of bodies that overlap (m, 2), lower id first, and by how much (m,) [m]."""
        data, model = self.data, self.model
        self._bring(pose)
        self._mujoco.mj_collision(model, data)
        if data.ncon == 0:  # at most of the many poses that a plan looks at
            return np.empty((0, 2), dtype=np.intp), np.empty(0)
        bodies = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        counts = (data.contact.dist < -DEPTH) & ~self._own[bodies[:, 0], bodies[:, 1]]
        return bodies[counts], -data.contact.dist[counts]

    def _bring(self, pose: Array) -> None:
        """Bring the shapes to where they are at a pose (n,) [rad]."""
        self.data.qpos[self._places] = pose
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)

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
    count = require_free(arm_file, geometry, ways_along(plan, here))
    without = f", without {geometry.left_out}" if geometry.left_out else ""
    return f"no collision at {count} poses along the way{without}"


def require_free(arm_file: ArmFile, geometry: Geometry, ways: Iterable[tuple[str, Array, Array]]) -> int:
    """How many poses were looked at on ways, each with its description, from a pose (n,) [rad] at which the arm stands
    to another; raises Collided at the first contact."""
    count = 0
    for place, begin, end in ways:
        for pose, touching in geometry.way(begin, end, standing=True):
            count += 1
            if touching:
                first, second = touching[0].bodies
                raise Collided(
                    f"{arm_file.name}: {first} would touch {second} {place}, {touching[0].depth * 1000:.1f} mm deep, at"
                    f" {' '.join(f'{angle:.3f}' for angle in pose)} rad: narrow lower and upper of these joints in the"
                    " arm file, or clear the workspace"
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
                require_free(arm_file, geometry, [(place, *leg) for leg in pairwise(way)])
            return way
        except Collided as collided:
            found.append(collided)
    raise found[0]


def ways_along(plan: SweepPlan, here: Array | None = None) -> Iterator[tuple[str, Array, Array]]:
    """(Description, first and last pose (n,) [rad]) of all motion of a plan, from one pose to the next, the first from
    `here` (n,) [rad]."""
    for number, scouted in enumerate(plan.scout, start=1):
        goal, first = np.array(scouted), number == 1 and here is not None
        place = TO_THE_PLAN if first else f"on the way to pose {number} of the {SCOUT_TITLE}"
        yield place, goal if here is None else here, goal
        here = goal
    for sweep in plan.sweeps:
        begin, end = sweep_ends(sweep)
        yield f"on the way to sweep {sweep.name}", begin if here is None else here, begin
        yield f"in sweep {sweep.name}", begin, end
        here = begin


def sweep_ends(sweep: Sweep) -> tuple[Array, Array]:
    """First and last pose (n,) [rad] on the way of a sweep: each step is approached from before it."""
    begin = np.array(sweep.rest)
    end = begin.copy()
    begin[sweep.joint], end[sweep.joint] = sweep.steps[0] - APPROACH, sweep.steps[-1] + APPROACH
    return begin, end
