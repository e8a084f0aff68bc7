"""Files are written beside their name and take it when they are whole and on disk: what stood there is kept until then.

A full disk, a kill or an error in between leaves the old file as it was.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from armlink.errors import BadInput

FLUSH_SECONDS = 0.5
"""Interval of flushes of what is recorded: a killed recorder loses at most this and what the operating system had not
written."""
NO_ROOM_BESIDE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG)
"""Why no file can be made in a folder in which one may be written: such a file is written in place."""


def file_identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of the file of that name, by which one that has taken the name is told; None without one."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def part_of(path: Path) -> Path:
    """Path of the file while it is being written."""
    return path.with_name(path.name + ".part")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raises BadInput where a file cannot be written."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{error.filename or path}: cannot be written: {error.strerror or error}") from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8; raises OSError that names it."""
    with open_whole(path) as stream:
        stream.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def open_whole(path: Path) -> Iterator[IO[bytes]]:
    """A stream to write a file with; it takes its name when the block ends without an error.

    Devices and pipes are written to directly. Raises OSError that names the file.
    """
    with _naming(path):
        end = Path(os.path.realpath(path))  # a link stays a link
        stream = None if path.exists() and not path.is_file() else _new_part(end)
        if stream is None:
            with path.open("wb") as in_place:
                yield in_place
            return
        try:
            with stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(part_of(end), end)
        except BaseException:
            with suppress(OSError):
                os.unlink(part_of(end))
            raise


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Errors name the file that was asked for; those of a full disk name none by themselves."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and (error.filename is None or str(error.filename).endswith(".part")):
            error.filename = str(path)
        raise


def _new_part(path: Path) -> IO[bytes] | None:
    """The part, opened, with the rights of the file that it replaces; None where it must be written in place."""
    replaced, part = path.is_file(), part_of(path)
    try:
        part.unlink(missing_ok=True)
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    except OSError as error:
        if replaced and error.errno in NO_ROOM_BESIDE:
            return None
        raise
    if replaced:
        os.fchmod(descriptor, stat.S_IMODE(path.stat().st_mode))
    return open(descriptor, "wb")
