"""The console command: usage, errors as one line, exit statuses. The commands here are made up."""

import os
import re
import signal
import subprocess
import sys
import types
from importlib.metadata import EntryPoint

import pytest
import typer

from armlink import cli
from armlink.errors import BadInput, BusFault, Declined, Refused


@pytest.fixture
def command(monkeypatch):
    """Registers one function (or typer app) as the only command, `work`."""

    def register(target):
        module = types.ModuleType("made_up_command")
        module.target = target
        monkeypatch.setitem(sys.modules, "made_up_command", module)
        point = EntryPoint(name="work", value="made_up_command:target", group="armlink.commands")
        monkeypatch.setattr(cli, "contributions", lambda group: [point])

    return register


def raising(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (BadInput("arm.yaml: key link.rate: too big (value 9000)"), 2, "key link.rate: too big (value 9000)"),
        (Refused("joint_3: RMS 0.4 N·m exceeds 0.1 N·m"), 1, "joint_3: RMS 0.4 N·m exceeds 0.1 N·m"),
        (BusFault("node 4 does not answer"), 3, "node 4 does not answer"),
        (BadInput("two\nlines"), 2, "two lines"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (typer.Abort(), 130, "interrupted"),
        (Declined("the answer was no: nothing was done"), 130, "the answer was no: nothing was done"),
        (FileNotFoundError(2, "No such file or directory", "gone.csv"), 2, "gone.csv: No such file or directory"),
        (PermissionError(13, "Permission denied", "/out"), 2, "/out: Permission denied"),
        (OSError(28, "No space left on device"), 2, "work: No space left on device"),
    ],
)
def test_an_error_is_one_line_and_its_exit_status(command, capsys, error, status, line):
    command(raising(error))
    assert cli.run(["work"]) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("armlink: ")
    assert err.splitlines() == [err.strip()]
    assert line in err


def test_an_error_of_another_package_s_own_tree_counts_too(command, capsys):
    class WrongShape(ValueError):
        exit_status = 2

    command(raising(WrongShape("q has 6 columns; expected 7")))
    assert cli.run(["work"]) == 2
    assert capsys.readouterr().err == "armlink: q has 6 columns; expected 7\n"


def test_a_bug_is_not_dressed_up_as_bad_input(command):
    command(raising(ZeroDivisionError("ours")))
    with pytest.raises(ZeroDivisionError):
        cli.run(["work"])


@pytest.mark.parametrize("outcome", [0, 1])
def test_a_command_may_return_its_exit_status(command, outcome):
    command(lambda: outcome)
    assert cli.run(["work"]) == outcome


def test_an_exit_that_typer_raises_keeps_its_code(command):
    command(raising(typer.Exit(1)))
    assert cli.run(["work"]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["work", "--nope"], "--nope"),
        (["work", "--count", "many"], "'--count': Input should be a valid integer"),
        (["work", "--count"], "--count"),
        (["work", "surplus"], "surplus"),
        (["wrok"], "no command 'wrok'"),
        (["--nope"], "no command '--nope'"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(command, capsys, arguments, words):
    def work(count: int = 1) -> None: ...

    command(work)
    assert cli.run(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("armlink: ")
    assert err.count("\n") == 1
    assert words in err


def test_a_group_of_commands_without_one_shows_its_help(command, capsys):
    app = typer.Typer(help="Groups.")
    app.command(name="one")(lambda: None)
    app.command(name="two")(lambda: None)
    command(app)
    assert cli.run(["work"]) == 0
    assert "one" in capsys.readouterr().out


def test_a_sub_command_s_error_names_its_status(command, capsys):
    app = typer.Typer()
    app.command(name="one")(raising(BadInput("no such recording")))
    app.command(name="two")(lambda: None)
    command(app)
    assert cli.run(["work", "one"]) == 2
    assert capsys.readouterr().err == "armlink: no such recording\n"
    assert cli.run(["work", "three"]) == 2
    assert "three" in capsys.readouterr().err


def test_no_command_shows_what_there_is_and_is_bad_usage(capsys):
    assert cli.run([]) == 2
    assert "demo" in capsys.readouterr().out


def test_help_and_version_say_what_it_is(capsys):
    assert cli.run(["--help"]) == 0
    assert "Usage: armlink COMMAND" in capsys.readouterr().out
    assert cli.run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("armlink 0.")


WAITING = """
import sys, types
from importlib.metadata import EntryPoint
from armlink import cli
def work():
    try:
        print("working", flush=True)
        sys.stdin.read()
    finally:
        print("joints safe", flush=True)
module = types.ModuleType("made_up"); module.work = work; sys.modules["made_up"] = module
cli.contributions = lambda group: [EntryPoint("work", "made_up:work", group)]
sys.argv = ["armlink", "work"]
cli.main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_work_in_order(number):
    with subprocess.Popen(
        [sys.executable, "-c", WAITING],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "working\n"
        process.send_signal(number)
        assert process.stdout.read() == "joints safe\n"
        assert process.wait(timeout=60) == 130
        assert "Traceback" not in process.stderr.read()


def test_a_reader_that_goes_away_is_no_error():
    source = WAITING.replace("sys.stdin.read()", "[print('x' * 1000, flush=True) for _ in range(1000)]").replace(
        'print("joints safe", flush=True)', "pass"
    )
    with subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert b"Traceback" not in process.stderr.read()


HELP = [sys.executable, "-c", "import sys; from armlink.cli import main; sys.argv[1:] = ['--help']; main()"]
MOST_MODULES = 200
"""That `armlink --help` may load, those of Python's own start among them; it loaded 168 when it took 0.1 s."""


def test_help_loads_few_modules_and_no_heavy_package():
    command = [HELP[0], "-X", "importtime", *HELP[1:]]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    loaded = {line.rpartition("|")[2].strip().partition(".")[0] for line in lines}
    assert "armlink" in loaded
    assert not loaded & {"numpy", "scipy", "pydantic", "typer", "rich", "can", "canopen", "mujoco", "pyarrow", "plotly"}
    assert len(lines) <= MOST_MODULES


@pytest.mark.long
def test_help_takes_less_than_0_3_s_of_cpu():
    child = subprocess.Popen(HELP, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0
    assert usage.ru_utime + usage.ru_stime < 0.3


def commands() -> dict[str, EntryPoint]:
    return {point.name: point for point in cli.contributions("armlink.commands")}


SUB_COMMANDS = [(name,) for name in sorted(commands())] + [
    ("gap", name) for name in ("diagnose", "plan", "collect", "diagnose-fleet", "trend", "bench")
]


@pytest.mark.parametrize("words", SUB_COMMANDS, ids=" ".join)
def test_every_help_has_an_example_that_begins_with_the_command(words, capsys):
    assert cli.run([*words, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Usage: armlink " + words[0] in text
    assert f"Example: armlink {words[0]}" in text


@pytest.mark.parametrize("words", SUB_COMMANDS, ids=" ".join)
def test_a_help_with_many_options_groups_them_and_keeps_units(words, capsys):
    assert cli.run([*words, "--help"]) == 0
    text = capsys.readouterr().out
    sections = re.findall(r"^(\w.*):\n", text, re.MULTILINE)
    if len(re.findall(r"^  --", text, re.MULTILINE)) > 11:
        assert len([each for each in sections if each != "Arguments"]) > 1
    if words == ("gap", "diagnose"):
        common = text.partition("Options:\n")[2].partition("\n\n")[0]
        assert re.findall(r"^  (--[a-z-]+)", common, re.MULTILINE) == [
            *("--sim", "--train", "--heldout", "--json", "--report", "--out-model", "--help")
        ]
        assert "[rad]" in text
        assert "[s]" in text


def test_the_list_is_sorted_one_line_each_in_one_style(capsys):
    cli.run(["--help"])
    listed = capsys.readouterr().out.partition("Commands:\n")[2].partition("\n\n")[0].splitlines()
    names = [line.split()[0] for line in listed]
    assert names == sorted(commands())
    for line in listed:
        summary = line.split(None, 1)[1]
        assert re.match(r"[A-Z][a-z]+s\b", summary), line
        assert summary.endswith("."), line


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["swep"], "did you mean sweep?"),
        (["calibrat", "x"], "did you mean calibrate?"),
        (["--verson"], "did you mean --version?"),
        (["my-arm.urdf"], "armlink new my-arm.urdf"),
        (["sweep", "sarcos", "--outt", "x"], "did you mean --out?"),
        (["monitor", "sarcos", "--stat"], "did you mean --stats?"),
        (["gap", "diagnos"], "did you mean diagnose"),
        (["demo", "sarcos", "--arm", "parallel6"], "two arms"),
        (["demo", "--arm", "sarocs"], "did you mean sarcos?"),
        (["completion", "tcsh"], "bash, zsh, fish"),
    ],
)
def test_a_typo_names_what_was_meant(arguments, meant, capsys):
    assert cli.run(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert meant in err


@pytest.mark.parametrize(
    ("words", "some", "none"),
    [
        ([""], ["sweep", "new", "completion", "--version"], ["sarcos"]),
        (["swe"], ["sweep"], ["new"]),
        (["sweep", ""], ["sarcos", "parallel6"], []),
        (["sweep", "sarcos", "--re"], ["--reference-mass", "--resume"], ["--out"]),
        (["gap", "di"], ["diagnose", "diagnose-fleet"], ["plan"]),
        (["gap", "diagnose", "--he"], ["--heldout", "--help"], []),
        (["completion", ""], ["bash", "fish", "zsh"], []),
        (["nosuch", ""], [], []),
    ],
)
def test_completion_offers_what_can_follow(words, some, none, capsys):
    assert cli.run(["--complete", *words]) == 0
    offered = capsys.readouterr().out.split()
    assert set(some) <= set(offered)
    assert not set(none) & set(offered)


def test_completion_works_in_bash(capsys):
    assert cli.run(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    asked = f'{script}\nCOMP_WORDS=(armlink calib); COMP_CWORD=1; _armlink; echo "${{COMPREPLY[*]}}"'
    path = f"{os.path.dirname(sys.executable)}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", asked], env={**os.environ, "PATH": path}, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["calibrate"]


@pytest.mark.parametrize(
    ("module", "extra"),
    [
        ("fastapi", "daemon"),
        ("uvicorn", "daemon"),
        ("prometheus_client", "daemon"),
        ("distributed", "cluster"),
        ("mcap", "bags"),
        ("pyarrow", "parquet"),
        ("plotly", "reports"),
        ("msgpack", "simulator"),
        ("psycopg", "postgresql"),
    ],
)
def test_a_missing_extra_is_named(command, capsys, module, extra):
    command(raising(ModuleNotFoundError(f"No module named {module!r}", name=module)))
    assert cli.run(["work"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"armlink: work: {module} (extra {extra}) is not installed: {sys.executable} -m pip install")


def test_the_daemon_names_its_own_extra_before_it_begins_anything(monkeypatch, capsys):
    monkeypatch.setattr("armlink.extras.find_spec", lambda module: None if module == "uvicorn" else object())
    assert cli.run(["daemon", "no-such-arm"]) == 2
    said, remedy = "armlink: daemon: uvicorn (extra daemon) is not installed", f"{sys.executable} -m pip install"
    assert capsys.readouterr().err == f"{said}: {remedy} 'uvicorn>=0.30'\n"


def test_another_missing_module_is_a_bug(command):
    command(raising(ModuleNotFoundError("No module named 'numpy'", name="numpy")))
    with pytest.raises(ModuleNotFoundError):
        cli.run(["work"])


def test_the_package_states_its_pythons():
    from importlib.metadata import metadata

    stated = metadata("armlink")
    assert stated["Requires-Python"] == ">=3.11"
    pythons = [each for each in stated.get_all("Classifier") if each.startswith("Programming Language")]
    assert [each[-4:] for each in pythons] == ["3.11", "3.12", "3.13"]
    assert {"all", "daemon", "cluster", "simulator"} <= set(stated.get_all("Provides-Extra"))
