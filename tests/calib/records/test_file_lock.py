"""A directory or file in use: the second user is refused, with who has it."""

import os
import threading

import pytest

from armlink.errors import BadInput
from calib.records.file_lock import lock_file, locked_directory


def test_a_directory_in_use_is_refused_and_named(tmp_path):
    with locked_directory(tmp_path, "--state here"):
        says = rf"--state here: in use by .*\(process {os.getpid()}\): stop that process, or choose another one"
        with pytest.raises(BadInput, match=says), locked_directory(tmp_path, "--state here"):
            pass
    with locked_directory(tmp_path, "--state here"):
        pass


def test_who_is_patient_gets_it_when_it_is_free(tmp_path):
    taken = (tmp_path / "file").open("w")
    lock_file(taken.fileno(), "file")
    free = threading.Timer(0.2, taken.close)
    free.start()
    with (tmp_path / "file").open("w") as again:
        lock_file(again.fileno(), "file", patience=30.0)
    free.join()


def test_a_directory_that_is_not_there_is_one_line(tmp_path):
    with (
        pytest.raises(BadInput, match="cannot be locked: No such file"),
        locked_directory(tmp_path / "no", "--state no"),
    ):
        pass
