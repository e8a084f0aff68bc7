"""Ways that no plan has: to the first pose, of a resumed pass, and back after a slip or a stall, around what stands
there."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_arm import along, bench, post
from sweep_arms import at_rate, with_section
from walls import Walls, Watched

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import HostLate
from armlink.link.link import Link
from calib.dataset import load_data
from calib.motion.mover import Mover, Slipped, Stalled
from calib.plan.collisions import Collided
from calib.plan.planned_arm import PlannedArm
from calib.plan.sweep_plan import plan_sweep
from calib.plan.types import APPROACH
from calib.sweep import step_pass
from calib.sweep.run import run_sweep
from calib.sweep.step_pass import STOP_DISTANCE
from gcomp.arrays import Array
from sim_bus.bus.lock_step import LockStepBus
from sim_bus.simulated_arm import SimulatedArm
from sim_bus.truth import Truth

pytestmark = pytest.mark.slow

POST = post(*along(0.5, 0.0, 0.8), half=0.02)
SWEPT = "on the way from its present pose to sweep elbow.1"


class PowerCut(Exception):
    """It stops the first attempt."""


@contextmanager
def standing(arm: ArmFile, pose: Sequence[float]) -> Iterator[Watched]:
    """The simulated arm, switched on where a hand put it."""
    simulated = SimulatedArm(arm, Truth.of(arm), 1)
    for joint, angle in enumerate(pose):
        simulated.turn_by_hand(joint, float(angle))
    with Link(arm, LockStepBus(arm=simulated)) as link:
        link.start()
        link.enable()
        yield Watched(link)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> ArmFile:
    folder = tmp_path_factory.mktemp("arm")
    (folder / "simulated.yaml").write_text(f"{Path(bench(folder, POST).path).read_text()}sim: {{}}")
    return with_section(at_rate(load_arm(str(folder / "simulated.yaml")), 50.0), steps=5, poses=1, gain_std=0.1)


@pytest.fixture(scope="module")
def cut(arm: ArmFile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pass that ends after the first reading of its first sweep."""
    folder = tmp_path_factory.mktemp("pass") / "bare"

    def ends(done: int, total: int, left: float, text: str) -> None:
        if any(reading.joint is not None for reading in load_data(folder).readings):
            raise PowerCut

    with standing(arm, (0.0, 0.0)) as watched, pytest.raises(PowerCut):
        run_sweep(watched.link, arm, folder, progress=ends)
    return folder


@dataclass(frozen=True)
class Bench:
    """A pass that was cut off, and a pose whose ways to the next reading, straight and by the plan's first pose, are
    clear or not."""

    folder: Path
    there: Array
    walls: Walls

    @property
    def begun(self) -> Array:
        return next_pose(self.folder)


@pytest.fixture
def between(
    arm: ArmFile, cut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, straight: bool, by_refuge: bool
) -> Bench:
    plan = load_data(cut).plan
    assert plan is not None
    there, refuge, goal = np.array([0.3, 0.9]), np.array(plan.scout[0]), next_pose(cut)
    ways = [*[(there, goal)] * (not straight), *[(there, refuge)] * (not by_refuge)]
    walls = Walls(*ways)
    assert walls.free(np.linspace(refuge, goal, 100)).all()
    monkeypatch.setattr(step_pass, "PlannedArm", lambda arm: SimpleNamespace(geometry=walls))
    return Bench(Path(shutil.copytree(cut, tmp_path / "bare")), there, walls)


def next_pose(folder: Path) -> Array:
    """Where the arm stands before the second reading of the first sweep, not yet pressed."""
    plan = load_data(folder).plan
    assert plan is not None
    sweep = plan.sweeps[0]
    pose = np.array(sweep.rest)
    pose -= np.array(sweep.stops) * (STOP_DISTANCE + 0.02 * np.abs(pose))
    pose[sweep.joint] = sweep.steps[1] - APPROACH
    return pose


def test_a_pass_whose_first_way_touches_is_refused_before_anything_moves(arm: ArmFile, tmp_path: Path) -> None:
    first, planned = np.array(plan_sweep(arm).scout[0]), PlannedArm(arm)
    poses = planned.free_poses(10, np.random.default_rng(2))
    here = next(pose for pose in poses if not planned.is_clear(pose, first))
    with standing(arm, here) as watched:
        with pytest.raises(Collided, match="on the way from its present pose to the first pose"):
            run_sweep(watched.link, arm, tmp_path / "bare")
        np.testing.assert_allclose(watched.kept, [here] * len(watched.kept), atol=1e-3)
    assert not load_data(tmp_path / "bare").readings


def resumed(arm: ArmFile, watched: Watched, folder: Path, **options: Any) -> None:
    """Resume a pass until its next reading is on disk."""
    before = len(load_data(folder).readings)

    def ends(done: int, total: int, left: float, text: str) -> None:
        if len(load_data(folder).readings) > before:
            raise PowerCut

    with pytest.raises(PowerCut):
        run_sweep(watched.link, arm, folder, resume=True, progress=ends, **options)


@pytest.mark.parametrize(("straight", "by_refuge"), [(True, False), (False, True)])
def test_a_resumed_pass_goes_around_what_stands_in_the_way(arm: ArmFile, between: Bench) -> None:
    with standing(arm, between.there) as watched:
        resumed(arm, watched, between.folder)
    assert between.walls.free(np.array(watched.kept)).all()


@pytest.mark.parametrize(("straight", "by_refuge"), [(False, False)])
def test_a_resumed_pass_without_a_clear_way_is_refused_before_anything_moves(arm: ArmFile, between: Bench) -> None:
    with standing(arm, between.there) as watched:
        with pytest.raises(Collided, match=SWEPT):
            run_sweep(watched.link, arm, between.folder, resume=True)
        np.testing.assert_allclose(watched.kept, [between.there] * len(watched.kept), atol=1e-3)


def test_a_pass_that_is_resumed_among_its_first_poses_leaves_out_what_it_does_not_get_to(
    arm: ArmFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The way from the present pose to the next pose is no way of the plan."""
    folder, here = tmp_path / "bare", np.array([0.3, 0.9])
    first, second, third = (np.array(pose) for pose in plan_sweep(arm).scout[:3])

    def ends(done: int, total: int, left: float, text: str) -> None:
        raise PowerCut

    with standing(arm, first) as watched, pytest.raises(PowerCut):
        run_sweep(watched.link, arm, folder, progress=ends)
    walls = Walls((here, second))
    assert walls.free(np.linspace(here, third, 100)).all()
    monkeypatch.setattr(step_pass, "PlannedArm", lambda arm: SimpleNamespace(geometry=walls))
    with standing(arm, here) as watched:
        resumed(arm, watched, folder)
    assert [reading.index for reading in load_data(folder).readings] == [0, 2]
    assert walls.free(np.array(watched.kept)).all()


@pytest.mark.parametrize("trouble", ["slip", "block", "stall"])
@pytest.mark.parametrize(("straight", "by_refuge"), [(True, False), (False, True), (False, False)])
def test_after_a_slip_or_a_stall_the_way_back_goes_around_what_stands_there(
    arm: ArmFile, between: Bench, monkeypatch: pytest.MonkeyPatch, trouble: str, straight: bool, by_refuge: bool
) -> None:
    """The trouble leaves the arm elsewhere; the way to there does not count."""
    rest, begun, there = Mover.rest, list[int](), between.there

    def once(mover: Mover, *args: Any) -> Any:
        if begun:
            return rest(mover, *args)
        mover.hold_all()
        mover.travel(there, 3.0)
        begun.append(len(watched.kept))
        if trouble == "slip":
            raise Slipped("shoulder", 0)
        if trouble == "block":
            raise Stalled("shoulder", 0.0, 0.0, 0)
        mover.link.stop()
        raise HostLate(0.18, 0.1)

    monkeypatch.setattr(Mover, "rest", once)
    with standing(arm, between.begun) as watched:
        if straight or by_refuge:
            resumed(arm, watched, between.folder, on_stall=lambda stall: True)
        else:
            with pytest.raises(Collided, match=SWEPT):
                run_sweep(watched.link, arm, between.folder, resume=True, on_stall=lambda stall: True)
            held = watched.kept[begun[0] :]
            np.testing.assert_allclose(held, [there] * len(held), atol=0.02)
    assert between.walls.free(np.array(watched.kept[begun[0] :])).all()
