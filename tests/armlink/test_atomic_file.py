"""What stood in a file stays until the new content is whole: on a full disk nothing is lost."""

import json
import os
import resource
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from armlink.cli import run
from armlink.commands.output import write_json
from armlink.content.atomic_file import open_whole, write_whole
from armlink.recording.files import load_recording, save_recording
from armlink.recording.recording import Recording
from calib.report.page import ReportSection, paragraph, render
from sim_gap.better_model.training_files import write_rows

SUFFIXES = (".csv", ".csv.gz", ".parquet", ".mcap")


@contextmanager
def full_disk(room: int = 100) -> Iterator[None]:
    """Within the block no file grows beyond `room` bytes, as on a disk that is nearly full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def recording(rows: int) -> Recording:
    random = np.random.default_rng(rows)
    return Recording(t=np.arange(rows) * 0.01, position=random.normal(size=(rows, 2)), torque=np.ones((rows, 2)))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_convert_onto_a_file_on_a_full_disk_keeps_it(suffix, tmp_path, capsys):
    source, target = tmp_path / "run.csv", tmp_path / f"kept{suffix}"
    save_recording(recording(500), source)
    save_recording(recording(20), target)
    before = target.read_bytes()
    with full_disk():
        assert run(["convert", str(source), str(target)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"armlink: {target}: cannot be written: ")
    assert error.count("\n") == 1
    assert target.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([source.name, target.name])
    assert run(["convert", str(source), str(target)]) == 0
    assert load_recording(target).t.size == 500


WRITERS = {
    "answer.json": lambda path: write_json(path, {"values": list(range(1000))}),
    "report.html": lambda path: render(path, "report", [ReportSection("one", paragraph("text " * 100))]),
    "draws.csv": lambda path: write_rows([{"a": k / 3} for k in range(1000)], path),
    "draws.json": lambda path: write_rows([{"a": k / 3} for k in range(1000)], path),
    "draws.parquet": lambda path: write_rows([{"a": k / 3} for k in range(1000)], path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_a_command_writes_replaces_nothing_until_it_is_whole(name, tmp_path):
    path = tmp_path / name
    path.write_text("kept")
    with full_disk(), pytest.raises(Exception, match=name.replace(".", r"\.")):
        WRITERS[name](path)
    assert path.read_text() == "kept"
    assert list(tmp_path.iterdir()) == [path]
    WRITERS[name](path)
    assert path.read_bytes() != b"kept"


def test_an_answer_on_a_full_disk_is_one_line(tmp_path, capsys):
    out = tmp_path / "drives.json"
    out.write_text("kept")
    with full_disk():
        assert run(["drives", "--json", str(out)]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"armlink: {out}: ")
    assert out.read_text() == "kept"


def test_an_error_while_writing_keeps_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("kept")

    def write() -> None:
        with open_whole(path) as stream:
            stream.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert path.read_text() == "kept"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_one_and_rights_stay_as_they_are(tmp_path):
    path, link = tmp_path / "file", tmp_path / "link"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    write_whole(link, "new")
    assert link.is_symlink()
    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_what_a_killed_writer_left_is_replaced(tmp_path):
    (tmp_path / "file.part").write_text("left")
    write_whole(tmp_path / "file", "new")
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_link_in_the_place_of_the_part_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("kept")
    (tmp_path / "file.part").symlink_to(victim)
    write_whole(tmp_path / "file", "new")
    assert victim.read_text() == "kept"


def test_devices_and_pipes_are_written_to(tmp_path):
    write_whole(Path(os.devnull), "text")
    assert not Path(f"{os.devnull}.part").exists()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_json(pipe, {"a": 1})
    assert json.loads(os.read(reader, 100)) == {"a": 1}
    os.close(reader)
