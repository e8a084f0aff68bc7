"""One module imported from a text instead of its file, in this process and in the Python programs that it starts."""

import importlib.abc
import importlib.util
import os
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path


class Mutated(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Imports one module from a text instead of its file."""

    def __init__(self, name: str, path: Path, source: str) -> None:
        self.name, self.path, self.source = name, path, source

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Ours for the one module."""
        return importlib.util.spec_from_loader(name, self) if name == self.name else None

    def get_filename(self, name: str) -> str:
        """Where it would have come from."""
        return str(self.path)

    def get_data(self, path: str) -> bytes:
        """The text."""
        return self.source.encode()


def install(name: str, path: Path, source: str) -> None:
    """From now on, in this process."""
    sys.meta_path.insert(0, Mutated(name, path, source))


def install_in_children(folder: Path, name: str, path: Path, source: str) -> None:
    """In Python programs that are started from now on; `folder` is an empty one that outlives them."""
    (folder / "source.txt").write_text(source, encoding="utf-8")
    (folder / "sitecustomize.py").write_text(
        "from pathlib import Path\nfrom mutated import install\n"
        f"install({name!r}, Path({str(path)!r}), Path({str(folder / 'source.txt')!r}).read_text(encoding='utf-8'))\n",
        encoding="utf-8",
    )
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(folder), str(Path(__file__).parent), *([before] if before else [])])
