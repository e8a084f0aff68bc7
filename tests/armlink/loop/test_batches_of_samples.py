"""Samples go to the job a few at a time while more rows follow, and at once where the job waits for the last."""

import socket
from types import SimpleNamespace

import numpy as np
import pytest
from fake_joints import FakeBus, make_arm

from armlink.channel import Channel
from armlink.link.link import Link
from armlink.link.types import Setpoints
from armlink.loop import process
from armlink.loop.messages import Call, Play

ROWS, PERIOD = 9, 0.004


@pytest.fixture
def ticking(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_samples_wait_for_each_other_but_the_last_row_does_not(ticking: SimpleNamespace) -> None:
    ours, theirs = socket.socketpair()
    job = Channel(ours)
    with Link(make_arm(), FakeBus(range(1, 4))) as link:
        link.start()
        loop = process.DriveLoop(Channel(theirs), link)
        loop._handle(Call(1, "enable"))
        job.receive()
        here = link.latest_position
        loop._handle(Play(2, Setpoints.follow(np.tile(here, (ROWS, 1)))))
        came = []
        for _ in range(ROWS + 3):
            loop._cycle()
            came.append([row for id, row, _ in job.receive()])
            ticking.now += PERIOD
    theirs.close()
    assert came[:ROWS] == [[0], [], [1, 2], [], [3, 4], [], [5, 6], [], [7, 8]]
    assert came[ROWS:] == [[], [-1, -1], []]


class After:
    """An end after so many cycles, each of which takes its period."""

    orphaned = False

    def __init__(self, clock: SimpleNamespace, cycles: int) -> None:
        self.clock, self.cycles = clock, cycles

    @property
    def due(self) -> bool:
        self.clock.now += PERIOD
        self.cycles -= 1
        return self.cycles < 0


def test_while_rows_are_played_the_job_is_heard_where_its_samples_leave(
    ticking: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the loop hurries in those cycles alone; without rows it hears the job, and hurries, in each."""
    ours, theirs = socket.socketpair()
    with Link(make_arm(), FakeBus(range(1, 4))) as link:
        link.start()
        channel = Channel(theirs)
        loop = process.DriveLoop(channel, link)
        loop._handle(Call(1, "enable"))
        loop._handle(Play(2, Setpoints.follow(np.tile(link.latest_position, (ROWS, 1)))))
        heard, hurried = [], []
        receive, exchange = channel.receive, link._loop.exchange
        monkeypatch.setattr(channel, "receive", lambda: heard.append(loop._row) or receive())
        told = lambda *given: hurried.append(not link.commander.unhurried) or exchange(*given)  # noqa: E731
        monkeypatch.setattr(link._loop, "exchange", told)
        loop.run(After(ticking, ROWS))
        assert heard == [-1, 0, 2, 4, 6]
        assert hurried == [True, False] * (ROWS // 2) + [True]
        heard.clear()
        hurried.clear()
        loop.run(After(ticking, 3))
        assert len(heard) == 3
        assert all(hurried)
    ours.close()
    theirs.close()
