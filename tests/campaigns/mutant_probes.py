"""Probes at the places of mutants: a module imported with them tells which test comes past which place.

Standard library alone: Python programs that tests start import it as well.
"""

import ast
import builtins
import importlib.abc
import importlib.util
import marshal
import os
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType

FILE = "ARMLINK_MUTANT_REACH"
"""Names the file that the probes write to."""
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


class Probe:
    """Writes place and test once each, by one call, so that lines of several processes do not mix."""

    def __init__(self) -> None:
        self._file = os.open(os.environ[FILE], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self.fixture = ""
        """That is being set up for several tests; theirs is what it reaches."""
        self._seen = set[tuple[str, str]]()

    def __call__(self, key: str) -> None:
        """A place is reached."""
        owner = self.fixture or os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
        if (key, owner) not in self._seen:
            self._seen.add((key, owner))
            os.write(self._file, f"{key}\t{owner}\n".encode())


def _bodies(node: ast.AST) -> Iterator[list[ast.stmt]]:
    for field in ("body", "orelse", "finalbody"):
        if isinstance(found := getattr(node, field, None), list):
            yield found


def _smallest(node: ast.AST, line: int, within: bool) -> tuple[list[ast.stmt] | None, ast.stmt | None, bool]:
    """The innermost statement that begins on a line, the list it is in, and whether that is part of a function."""
    best: tuple[list[ast.stmt] | None, ast.stmt | None, bool] = (None, None, within)
    for child in ast.iter_child_nodes(node):
        inner = _smallest(child, line, within or isinstance(node, FUNCTION))
        if inner[1] is not None:
            return inner
    for body in _bodies(node):
        for statement in body:
            if isinstance(statement, ast.stmt) and statement.lineno == line:
                best = (body, statement, within or isinstance(node, FUNCTION))
    return best


def _users(tree: ast.Module, statement: ast.stmt | None) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Functions that may run what a statement outside of functions has set: those that name it, else all."""
    every = [node for node in ast.walk(tree) if isinstance(node, FUNCTION)]
    if isinstance(statement, FUNCTION):
        return [statement]  # a default or a decorator
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    names = {node.id for each in targets if each for node in ast.walk(each) if isinstance(node, ast.Name)}

    def named(function: ast.AST) -> bool:
        parts = {getattr(node, "id", "") for node in ast.walk(function)}
        return bool(names & (parts | {getattr(node, "attr", "") for node in ast.walk(function)}))

    return [each for each in every if named(each)] or every


def probed(path: Path, places: list[tuple[str, int]]) -> CodeType:
    """A module's code with a probe for each key, before the statement that begins on its line."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inserts: list[tuple[list[ast.stmt], ast.stmt, str]] = []
    for key, line in places:
        body, statement, within = _smallest(tree, line, within=False)
        if within and body is not None and statement is not None:
            inserts.append((body, statement, key))
        else:
            inserts += [(each.body, each.body[0], key) for each in _users(tree, statement)]
    for body, statement, key in inserts:
        call = ast.Expr(ast.Call(ast.Name("__reach__", ast.Load()), [ast.Constant(key)], []))
        body.insert(next(at for at, each in enumerate(body) if each is statement), ast.copy_location(call, statement))
    return compile(ast.fix_missing_locations(tree), str(path), "exec", dont_inherit=True)


class Probed(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Imports modules of which a folder has the code."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._names = folder, {path.stem for path in folder.glob("*.code")}

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Ours for those."""
        return importlib.util.spec_from_loader(name, self) if name in self._names else None

    def get_filename(self, name: str) -> str:
        """Where it comes from."""
        return (self._folder / f"{name}.path").read_text(encoding="utf-8")

    def get_data(self, path: str) -> bytes:
        """The file."""
        return Path(path).read_bytes()

    def get_code(self, name: str) -> CodeType:
        """With the probes."""
        code: CodeType = marshal.loads((self._folder / f"{name}.code").read_bytes())
        return code


def write(folder: Path, name: str, path: Path, places: list[tuple[str, int]]) -> None:
    """Put a module's code into the folder."""
    (folder / f"{name}.path").write_text(str(path), encoding="utf-8")
    (folder / f"{name}.code").write_bytes(marshal.dumps(probed(path, places)))


def install(folder: Path) -> Probe:
    """Import from this folder from now on, in this process."""
    probe = Probe()
    vars(builtins)["__reach__"] = probe
    sys.meta_path.insert(0, Probed(folder))
    return probe


def install_in_children(folder: Path) -> None:
    """In Python programs that are started from now on."""
    (folder / "sitecustomize.py").write_text(
        f"from pathlib import Path\nfrom mutant_probes import install\ninstall(Path({str(folder)!r}))\n",
        encoding="utf-8",
    )
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(folder), str(Path(__file__).parent), *([before] if before else [])])
