"""Work in a process of its own: its answer, its error, its end."""

import os
import subprocess
import sys
import time

import pytest

from armlink.errors import BadInput
from sim_gap.demo import run as module
from sim_gap.demo.run import beside


def place(number: int) -> tuple[int, int]:
    return os.getpid(), 2 * number


def refuse(why: str) -> None:
    raise BadInput(why)


def vanish() -> None:
    os._exit(3)


@pytest.mark.parametrize("cores", [1, 2])
def test_the_answer_and_the_error_are_those_of_the_work(monkeypatch: pytest.MonkeyPatch, cores: int) -> None:
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _: set(range(cores)))
    with beside(place, number=21) as answer:
        process, made = answer()
    assert made == 42
    assert (process == os.getpid()) == (cores == 1)
    with beside(refuse, "too little") as answer, pytest.raises(BadInput, match="too little"):
        answer()


def test_it_goes_on_at_once_and_nobody_waits_for_what_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _: {0, 1})
    began = time.monotonic()
    with pytest.raises(BadInput), beside(time.sleep, 60.0):
        raise BadInput("another reason")
    assert time.monotonic() - began < 30.0


def test_a_worker_that_vanishes_is_an_error_and_no_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda _: {0, 1})
    with beside(vanish) as answer, pytest.raises(RuntimeError, match="terminated abruptly"):
        answer()


WORK = """
import os, time
from sim_gap.demo.run import beside

def work():
    print(os.getpid(), flush=True)
    time.sleep(300)

if __name__ == "__main__":
    with beside(work) as answer:
        answer()
"""


@pytest.mark.long
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs a core for the worker")
def test_a_worker_ends_with_a_process_that_is_killed(tmp_path) -> None:
    script = tmp_path / "killed.py"
    script.write_text(WORK, encoding="utf-8")
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        parent.stdout.readline()
        parent.kill()
        parent.communicate(timeout=60.0)  # the worker has the pipe open until it ends
