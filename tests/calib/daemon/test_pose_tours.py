"""Where the daemon drives an arm to by itself: nothing touches on the way, and the arm begins from where it is."""

import os
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from bench_arm import bench, post
from same_thread import Immediate

from armlink.arm_file import ArmFile, load_arm
from armlink.errors import BadInput, Refused
from armlink.link.types import Controller
from armlink.loop.messages import Batch, Progress
from calib.daemon.aside import in_process
from calib.daemon.environment import Environment
from calib.daemon.observation.pose_tours import PoseTours, chosen_poses
from calib.daemon.settings import Configuration, DaemonSection
from calib.daemon.view import State

SECONDS = 120
"""Of motion that is looked at."""


class Bench:
    """Tours of an arm that follows at once; choices are made when `choose` says so."""

    def __init__(self, arm: ArmFile, begin: np.ndarray, work: bool = False) -> None:
        self.said, self.moved, self.waiting = list[tuple[Any, ...]](), list[Any](), list[Any]()
        configuration, nothing = Configuration(arm, DaemonSection(work=work), listen_only=False), Immediate()
        environment = Environment(
            lambda: 0.0, lambda: datetime(2026, 11, 30, tzinfo=UTC), nothing, self, nothing, self.aside
        )
        self.state = State.OBSERVING
        self.tours = PoseTours(configuration, self, environment, lambda: self.state)  # type: ignore[arg-type]
        self.controllers: Any = None
        self.hear(begin)

    def say(self, *event: Any) -> None:
        self.said.append(event)

    def move(self, controller: Controller) -> None:
        self.moved.append(controller)

    def aside(self, work: Any, done: Any) -> None:
        self.waiting.append((work, done))

    def choose(self) -> None:
        """Let the choices that wait be made, and what they lead to."""
        while self.waiting:
            Immediate()(*self.waiting.pop(0))

    def hear(self, position: np.ndarray) -> None:
        at: Any = {"position_command": position[None]}
        self.tours.heard(Batch(np.zeros(1), at, None, None, None))  # type: ignore[arg-type]

    def motion(self, seconds: float) -> np.ndarray:
        """What the newest controller commands (K, n) [rad]."""
        controller = self.moved[-1]
        sample: Any = None
        commands: Iterator[Any] = iter(lambda: controller.command(sample), None)
        return np.array([command.position for command in islice(commands, round(seconds / controller.period))])


def overlap(arm: ArmFile, poses: np.ndarray) -> float:
    """The deepest overlap [m] of bodies that no joint connects, by MuJoCo itself."""
    assert arm.model_path is not None
    model = mujoco.MjModel.from_xml_path(str(arm.model_path))
    data, deepest = mujoco.MjData(model), 0.0
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        for contact in data.contact[: data.ncon]:
            first, second = model.geom_bodyid[contact.geom]
            if first not in (second, model.body_parentid[second]) and second != model.body_parentid[first]:
                deepest = max(deepest, -float(contact.dist))
    return deepest


def at_a_post(tmp_path: Path) -> ArmFile:
    """Three of a hundred poses and many ways between them lead through it."""
    return bench(tmp_path, post(0.3, 0.3))


@pytest.mark.parametrize("work", [False, True])
def test_no_command_of_a_tour_or_of_work_leads_through_a_body(tmp_path: Path, work: bool) -> None:
    arm, begin = at_a_post(tmp_path), np.zeros(2)
    daemon = Bench(arm, begin, work)
    if not work:
        daemon.tours.request("asked for")
    daemon.choose()
    commands = daemon.motion(SECONDS)
    assert np.abs(np.diff(commands, axis=0)).max() < 0.02
    assert np.ptp(commands, axis=0).min() > 1.0
    assert overlap(arm, commands[::10]) < 0.002


def test_a_tour_in_the_midst_of_work_begins_where_the_arm_comes_to_rest_and_work_goes_on(tmp_path: Path) -> None:
    arm = at_a_post(tmp_path)
    daemon = Bench(arm, np.zeros(2), work=True)
    daemon.choose()
    at_work = daemon.motion(7.0)
    daemon.hear(at_work[-30])
    daemon.tours.request("asked for")
    assert daemon.tours.progress == Progress(0, 60)
    np.testing.assert_array_equal(daemon.motion(1.0), np.tile(at_work[-30], (250, 1)))  # held while poses are chosen
    daemon.hear(at_work[-1])  # an older message: the arm was not at rest yet
    daemon.choose()
    assert len(daemon.moved[-1].tour) == 60
    np.testing.assert_array_equal(daemon.moved[-1].start, at_work[-1])
    commands = daemon.motion(3 * SECONDS)
    assert daemon.moved[-1].progress == (60, 60)
    assert overlap(arm, commands[::10]) < 0.002
    assert np.ptp(commands[-10_000:], axis=0).min() > 0.5  # work


def test_a_tour_waits_for_a_recalibration_that_began_meanwhile(tmp_path: Path) -> None:
    daemon = Bench(at_a_post(tmp_path), np.zeros(2))
    daemon.tours.request("asked for")
    daemon.state = State.RECALIBRATING
    Immediate()(*daemon.waiting.pop(0))
    assert len(daemon.moved[-1].tour) == 0
    daemon.state = State.SWEEPING
    daemon.choose()
    assert len(daemon.moved[-1].tour) == 60


@pytest.mark.parametrize("gone", ["stopped", "up"])
def test_a_choice_that_comes_after_the_bus_has_gone_moves_nothing(tmp_path: Path, gone: str) -> None:
    daemon = Bench(at_a_post(tmp_path), np.zeros(2))
    daemon.tours.request("asked for")
    getattr(daemon.tours, gone)()
    before = len(daemon.moved)
    daemon.choose()
    assert len(daemon.moved) == before
    assert daemon.tours.progress is None


def test_an_arm_that_touches_something_stays_where_it_is_and_the_bodies_are_named(tmp_path: Path) -> None:
    arm = bench(tmp_path, post(0.3, -0.02))
    daemon = Bench(arm, np.array([0.05, 0.0]))
    daemon.tours.request("asked for")
    daemon.choose()
    (refused,) = daemon.said
    assert refused[0] == "refused"
    assert "reaches no pose" in refused[2]
    assert "post" in refused[2]
    assert daemon.tours.progress is None
    assert len(daemon.moved[-1].tour) == 0


def test_poses_are_chosen_in_another_process_that_says_what_went_wrong(tmp_path: Path) -> None:
    arm = at_a_post(tmp_path)
    here = [each.tolist() for each in chosen_poses(arm, np.zeros(2), 4, 3, 7)]
    there = [each.tolist() for each in in_process(partial(chosen_poses, arm, np.zeros(2), 4, 3, 7))]
    assert here == there
    with pytest.raises(BadInput, match="nowhere"):
        in_process(partial(load_arm, "nowhere.yaml"))
    with pytest.raises(Refused, match="ended with status -6"):
        in_process(os.abort)
