"""Loads and saves recordings by file suffix."""

from pathlib import Path

from armlink.errors import BadInput
from armlink.recording.recording import Recording

SUFFIXES = (".csv", ".csv.gz", ".parquet", ".mcap")


def load_recording(path: str | Path) -> Recording:
    """Load `.csv`, `.csv.gz`, `.parquet` or `.mcap`; raises BadInput that names row or column."""
    path = Path(path)
    suffix = _suffix(path)
    if not path.is_file():
        raise BadInput(f"no recording {path}: give a {', '.join(SUFFIXES)} file")
    if suffix == ".mcap":
        from armlink.recording.mcap import load_mcap

        return load_mcap(path).check(str(path))
    from armlink.recording.tables import load_csv, load_parquet

    return (load_parquet if suffix == ".parquet" else load_csv)(path).check(str(path))


def save_recording(recording: Recording, path: str | Path) -> None:
    """Save by suffix (see load_recording); raises BadInput if the recording is not valid."""
    path = Path(path)
    suffix = _suffix(path)
    recording.check(str(path))
    if suffix == ".mcap":
        from armlink.recording.mcap import save_mcap

        save_mcap(recording, path)
        return
    from armlink.recording.tables import save_csv, save_parquet

    (save_parquet if suffix == ".parquet" else save_csv)(recording, path)


def _suffix(path: Path) -> str:
    for suffix in sorted(SUFFIXES, key=len, reverse=True):
        if path.name.lower().endswith(suffix):
            return suffix
    raise BadInput(f"{path}: not the suffix of a recording, expected {', '.join(SUFFIXES)}")
