"""Samples go to the job a few at a time while more rows follow, and at once where the job waits for the last."""

import socket
from types import SimpleNamespace

import numpy as np
import pytest
from fake_joints import FakeBus, make_arm

from armlink.link.link import Link
from armlink.link.types import Setpoints
from armlink.loop import process
from armlink.loop.channel import Channel
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
