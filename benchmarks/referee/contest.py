"""Runs the adapters: a process a case, in a copy of the public folder, within a limit of processor time."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from referee.interface import Answer, answer_from_json, check, load_case
from referee.measure import actuated

HERE = Path(__file__).parent
WALL_FACTOR = 20.0
"""Wall-clock time over processor time after which a process is ended: the machine may be busy."""
GRACE_S = 10.0
"""Processor time beyond the limit for writing an answer [s]."""
PROGRAM = """
import importlib.util, json, sys, traceback
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from referee.interface import Answer, NotOffered, load_case
try:
    spec = importlib.util.spec_from_file_location("adapter", sys.argv[2])
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    answer = module.solve(load_case(Path(".")))
    if not isinstance(answer, Answer):
        raise TypeError(f"solve returned {type(answer).__name__} instead of an Answer")
    made = {"state": "answered", "answer": answer.to_json()}
except NotOffered as error:
    made = {"state": "not offered", "why": str(error)}
except ImportError as error:
    made = {"state": "not installed", "why": str(error)}
except Exception as error:
    lines = [row.lineno for row in traceback.extract_tb(error.__traceback__) if row.filename == sys.argv[2]]
    place = f", line {lines[-1]}" if lines else ""
    made = {"state": "failed", "why": f"{type(error).__name__}: {error}{place}"[:300]}
Path("answer.json").write_text(json.dumps(made, default=float))
"""


@dataclass(frozen=True)
class Tool:
    """An adapter and the interpreter that runs it."""

    name: str
    adapter: Path
    python: str


def tools(more: list[Path], only: list[str]) -> list[Tool]:
    """The adapters beside this file and those given. `.referee/NAME/bin/python` runs one whose tool needs other
    versions than armlink."""
    found = []
    for path in [*sorted((HERE / "adapters").glob("*.py")), *more]:
        own = HERE.parents[1] / ".referee" / path.stem / "bin" / "python"
        found.append(Tool(path.stem, path.resolve(), str(own) if own.exists() else sys.executable))
    return [tool for tool in found if not only or tool.name in only]


def run(tool: Tool, public: Path, cpu_seconds: float) -> dict[str, Any]:
    """State, answer and processor seconds of one tool on one case. `state` is answered, not offered, not installed,
    failed or out of time; an answer that cannot be judged is a failure, and `why` says what is wrong."""
    with tempfile.TemporaryDirectory(prefix="referee-") as scratch:
        folder = Path(scratch) / "case"
        shutil.copytree(public, folder)
        command = [tool.python, "-c", PROGRAM, str(HERE.parent), str(tool.adapter)]
        limit = round(cpu_seconds + GRACE_S)
        with (folder.parent / "log").open("wb") as log:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=_environment(),
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5)),
            )
            used, ended_by = _wait(process, WALL_FACTOR * cpu_seconds)
        made: dict[str, Any] = {"state": "failed", "why": (folder.parent / "log").read_text(errors="replace")[-300:]}
        if (folder / "answer.json").is_file():
            made = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
        elif ended_by in (signal.SIGXCPU, signal.SIGKILL):
            made = {"state": "out of time", "why": f"more than {cpu_seconds:.0f} s"}
    if made["state"] == "answered":
        try:
            judgeable(answer_from_json(made["answer"]), public)
        except ValueError as error:
            made = {"state": "failed", "why": str(error)}
    return {**made, "cpu_seconds": used}


def judgeable(answer: Answer, public: Path) -> None:
    """Raise ValueError if an answer cannot be judged: its words, numbers and joints, and a model that MuJoCo takes."""
    case = load_case(public)
    check(answer, case)
    if answer.model is not None:
        try:
            model = mujoco.MjModel.from_xml_string(answer.model)
        except ValueError as error:
            raise ValueError(f"model: {error}") from error
        actuated(model, case.joints, case.kind)


def _wait(process: "subprocess.Popen[bytes]", wall_seconds: float) -> tuple[float, int]:
    """Processor time of the process and its children [s], and the signal that ended it, or 0; it is killed after
    `wall_seconds`."""
    end = time.monotonic() + wall_seconds
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return float(usage.ru_utime + usage.ru_stime), os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        if time.monotonic() > end:
            process.kill()
            end = float("inf")
        time.sleep(0.05)


def _environment() -> dict[str, str]:
    """One thread each, and nothing else that an adapter could learn from."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "LANG", "PYTHONPATH") if name in os.environ}
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**kept, **dict.fromkeys(threads, "1"), "PYTHONDONTWRITEBYTECODE": "1"}
