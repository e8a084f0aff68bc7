"""Loads and saves recordings by file suffix, and by folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from armlink.content.memory_budget import memory_budget
from armlink.errors import BadInput
from armlink.extras import require_extra
from armlink.recording.corrections import AS_IT_IS, Corrections
from armlink.recording.recording import Recording, take_joints

SUFFIXES = (".csv", ".csv.gz", ".parquet", ".mcap")


def load_recording(path: str | Path, stated: Corrections | None = None) -> Recording:
    """Load one recording (docs/formats.md): a file, or the folder of a ROS 2 bag.

    `stated` are corrections of the file's columns, signs, units and clocks, its joints numbered as it has them. Raises
    BadInput that names row or column, also for a data set of several recordings.
    """
    found = load_recordings(path, stated)
    if len(found) != 1:
        raise BadInput(f"{path}: holds {len(found)} recordings: choose one, such as {next(iter(found))}")
    return next(iter(found.values()))


def load_recordings(
    path: str | Path, stated: Corrections | None = None, poses: bool = False, efforts: bool = False
) -> dict[str, Recording]:
    """All recordings of a file or folder, by label; `FOLDER#2` is episode 2 of a LeRobot data set.

    `poses`: a CSV table without times is one of poses; with it or `efforts` those of a LeRobot data set are read.
    """
    stated = stated or AS_IT_IS
    folder, _, episode = str(path).rpartition("#")
    place = Path(folder) if episode.isdigit() and folder else Path(path)
    with memory_budget(place):
        found = _loaded(place, stated, poses, efforts)
    if episode.isdigit() and folder:
        if str(path) not in found:
            raise BadInput(f"{path}: no such episode: {folder} has {len(found)} episodes, numbered from 0")
        found = {str(path): found[str(path)]}
    return {label: stated.apply(_chosen(r, stated, label), label).check(label) for label, r in found.items()}


def _loaded(path: Path, stated: Corrections, poses: bool = False, efforts: bool = False) -> dict[str, Recording]:
    """The recordings of a path as they stand in it, but for their columns' names."""
    if (path / "meta" / "info.json").is_file():
        require_extra(str(path), "parquet")
        from armlink.recording.lerobot import load_lerobot

        return load_lerobot(path, efforts=poses or efforts)
    if (path / "metadata.yaml").is_file() or path.suffix in (".db3", ".bag"):
        return _of_bag(path, [path], stated)
    if path.is_dir():
        return _of_folder(path, stated)
    if path.suffix == ".zstd":
        raise BadInput(
            f"{path}: give the folder of the bag, with its metadata.yaml, or unpack this file first: zstd -d "
            f"{path.name}"
        )
    suffix = _suffix(path)
    if not path.is_file():
        raise BadInput(f"there is no recording {path}: give a {', '.join(SUFFIXES)} file")
    if suffix == ".mcap":
        require_extra(str(path), "bags")
        from armlink.recording.mcap import has_our_topics, load_mcap

        if not stated.topic and has_our_topics(path):
            return {str(path): load_mcap(path)}
        return _of_bag(path, [path], stated)
    if suffix == ".parquet":
        require_extra(str(path), "parquet")
        from armlink.recording.parquet import load_parquet

        return {str(path): load_parquet(path, stated.columns)}
    from armlink.recording.tables import load_csv

    return {str(path): load_csv(path, stated.columns, stated.header, poses)}


def _of_folder(path: Path, stated: Corrections) -> dict[str, Recording]:
    """The recording of a bag without `metadata.yaml`, as a recorder leaves it that was killed."""
    files = sorted(each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    if len(files) == 1:
        return {str(path): next(iter(_loaded(files[0], stated).values()))}
    if not files:
        raise BadInput(
            f"{path} is neither the folder of a ROS 2 bag (.mcap or .db3 files) nor a LeRobot data set (meta/info.json)"
        )
    return _of_bag(path, files, stated)


def _of_bag(path: Path, files: Sequence[Path], stated: Corrections) -> dict[str, Recording]:
    require_extra(str(path), "bags")
    from armlink.recording.ros_bag import load_bag

    return {str(path): load_bag(files, stated.topic)}


def _chosen(recording: Recording, stated: Corrections, label: str) -> Recording:
    if not stated.joints:
        return recording
    missing = [name for name in stated.joints if name not in recording.names]
    if missing:
        raise BadInput(f"--joints {missing[0]}: {label} has only the joints {', '.join(recording.names)}")
    left = [name for name in recording.names if name not in stated.joints]
    chosen = take_joints(recording, [recording.names.index(name) for name in stated.joints])
    note = f"joints left out: {', '.join(left)}" if left else ""
    return replace(chosen, warning="; ".join(filter(None, (recording.warning, note))))


def keeps_names(path: Path) -> bool:
    """Whether a recording written there keeps the names of its joints."""
    return _suffix(path) in (".mcap", ".parquet")


def save_recording(recording: Recording, path: str | Path) -> None:
    """Save by suffix (see load_recording); raises BadInput if the recording is not valid."""
    path = Path(path)
    suffix = _suffix(path)
    recording.check(str(path))
    if suffix == ".mcap":
        require_extra(str(path), "bags")
        from armlink.recording.mcap import save_mcap

        save_mcap(recording, path)
    elif suffix == ".parquet":
        require_extra(str(path), "parquet")
        from armlink.recording.parquet import save_parquet

        save_parquet(recording, path)
    else:
        from armlink.recording.tables import save_csv

        save_csv(recording, path)


def _suffix(path: Path) -> str:
    for suffix in sorted(SUFFIXES, key=len, reverse=True):
        if path.name.lower().endswith(suffix):
            return suffix
    raise BadInput(f"{path}: this suffix is not the suffix of a recording, expected {', '.join(SUFFIXES)}")
