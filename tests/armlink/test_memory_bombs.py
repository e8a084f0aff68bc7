"""Files that become large in memory are refused in one line, in bounded memory and time, by every reader."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bombs import BOMBS, LARGE

from armlink.content.file_content import MOST_NODES, parse_yaml, read_whole
from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput
from armlink.model_file import compile_model

HERE = Path(__file__).parent
SECONDS = 120.0
"""Time after which a reader counts as hung: they take some seconds in all, on a busy machine too."""
ONE_LINE = ("BadInput: ", "read: 'truncated ")


def outcomes(bombs: Mapping[str, Any], folder: Path) -> list[tuple[str, str, int]]:
    """(Name, what came of it, peak memory [MB]) of each, read by one process."""
    lines = [json.dumps([name, kind, str(make(folder))]) for name, (kind, make) in bombs.items()]
    command = [sys.executable, str(HERE / "bombs.py")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        command, input="\n".join(lines), env=env, capture_output=True, text=True, timeout=SECONDS, check=True
    )
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


def judge(found: list[tuple[str, str, int]], most: int) -> None:
    for name, said, peak in found:
        assert said.startswith(ONE_LINE), (name, said)
        assert "\n" not in said
        assert peak < most, (name, said, peak)


def test_small_files_that_become_large_take_no_memory(tmp_path):
    found = outcomes(BOMBS, tmp_path)
    assert [name for name, _, _ in found] == list(BOMBS)
    judge(found, 800)


@pytest.mark.long
@pytest.mark.parametrize("name", LARGE)
def test_larger_files_take_no_more_than_their_budget(name, tmp_path):
    (found,) = outcomes({name: LARGE[name]}, tmp_path)
    judge([found], 2300)


def test_what_takes_more_than_the_budget_is_bad_input_and_the_limit_is_gone_after_it(tmp_path, monkeypatch):
    path = tmp_path / "small"
    path.touch()
    monkeypatch.setattr("armlink.content.memory_budget.LEAST_BUDGET", 64 << 20)
    with pytest.raises(BadInput, match=r"would take more than 0\.1 GB of memory"), memory_budget(path):
        np.empty(8 << 30, np.uint8)
    assert np.empty(8 << 30, np.uint8).size == 8 << 30


def test_budgets_of_threads_do_not_mix(tmp_path):
    import resource
    from concurrent.futures import ThreadPoolExecutor

    before = resource.getrlimit(resource.RLIMIT_DATA)

    def read(_: int) -> None:
        with memory_budget(tmp_path), memory_budget(tmp_path):
            assert resource.getrlimit(resource.RLIMIT_DATA)[0] != before[0]

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(read, range(200)))
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


@pytest.mark.parametrize("text", ["a: &a [*a]\n", "a: &a {b: *a}\n"])
def test_an_alias_of_what_it_is_in_is_refused(text, tmp_path):
    with pytest.raises(BadInput, match="an alias refers to a part of the file that contains it"):
        parse_yaml(text, tmp_path / "a.yaml")


def test_aliases_that_stand_for_little_are_read(tmp_path):
    text = "limits: &limits {max: 1}\njoints: [" + ", ".join(["*limits"] * 100) + "]\nmore: {<<: *limits, min: 0}\n"
    found = parse_yaml(text, tmp_path / "a.yaml")
    assert found["joints"] == [{"max": 1}] * 100
    assert found["more"] == {"max": 1, "min": 0}
    assert MOST_NODES > 1000


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/stdin"])
def test_a_device_is_no_file(device):
    with pytest.raises(BadInput, match="is a folder or a device"):
        read_whole(Path(device), 100)


def test_a_model_with_some_replicas_and_keyframes_is_read(tmp_path):
    path = tmp_path / "good.xml"
    path.write_text(
        '<mujoco><size nkey="3" memory="20M"/><worldbody><replicate count="20" offset="1 0 0"><geom size="0.1"/>'
        '</replicate><body><joint name="j"/><geom size="1"/></body></worldbody></mujoco>'
    )
    assert compile_model(path).ngeom == 21
