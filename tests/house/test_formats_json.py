"""docs/formats.md holds to the answers in JSON, to the commands that give them and to the exit statuses."""

import ast
import inspect
import json
import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import typer

from armlink import cli, errors
from armlink.arm_file import load_arm
from calib.records.records import CalibrationRecord
from tests.house.conftest import keyed, part, rows

ROOT = Path(__file__).parent.parent.parent
PACKAGES = ("armlink", "calib", "gcomp", "sim_bus", "sim_gap")


def test_exit_statuses():
    known = {each.exit_status for each in vars(errors).values() if inspect.isclass(each)}
    assert {int(row["status"]) for row in rows("6.1")} == {0, cli.INTERRUPTED_STATUS, *known}


def commands_with_json() -> set[str]:
    found = set()
    for point in entry_points(group="armlink.commands"):
        target = point.load()
        inside = {point.name: target}
        if isinstance(target, typer.Typer):
            given = [(each.name or each.callback.__name__, each.callback) for each in target.registered_commands]
            inside = {f"{point.name} {name.replace('_', '-')}": function for name, function in given}
        found |= {
            name
            for name, function in inside.items()
            if {"json", "json_file"} & inspect.signature(function).parameters.keys()
        }
    return found


def test_every_command_with_json_has_its_section():
    index = {row["command"].strip("`").removeprefix("armlink "): row["section"] for row in rows("6.3")}
    assert index.keys() == commands_with_json()
    for link in index.values():
        number = re.match(r"\[([\d.]+)\]", link)[1]
        assert part(number)


def text_keys(node: ast.AST) -> set[str]:
    """String keys of every dictionary in a piece of code."""
    keys = [key for each in ast.walk(node) if isinstance(each, ast.Dict) for key in each.keys]
    return {key.value for key in keys if isinstance(key, ast.Constant) and isinstance(key.value, str)}


def dictionaries():
    """Schema, keys of the dictionary that carries it, whether these are all, and keys of what it holds; in all code."""
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = {each.name: each for each in tree.body if isinstance(each, ast.FunctionDef)}
        assigned = [each for each in tree.body if isinstance(each, ast.Assign) and isinstance(each.value, ast.Constant)]
        constants = {each.targets[0].id: each.value.value for each in assigned}
        for node in (node for node in ast.walk(tree) if isinstance(node, ast.Dict)):
            keys = [key.value if isinstance(key, ast.Constant) else None for key in node.keys]
            value = node.values[keys.index("schema")] if "schema" in keys else None
            schema = constants.get(value.id) if isinstance(value, ast.Name) else getattr(value, "value", None)
            if isinstance(schema, str) and schema.startswith("armlink."):
                called = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} & functions.keys()
                inside = text_keys(node).union(*(text_keys(functions[name]) for name in called))
                yield schema, set(filter(None, keys)), None not in keys, inside


def test_answers_that_name_their_schema():
    index = {row["schema"].strip("`"): row["section"] for row in rows("6.2")}
    code = list(dictionaries())
    assert index.keys() == {schema for schema, *_ in code} | {"armlink.sweep/1"}  # a model: section 3.1
    for schema, keys, whole, inside in code:
        number = re.match(r"\[([\d.]+)\]", index[schema])[1]
        page = {re.split(r"[.\[]", key)[0] for key in keyed(number)}
        assert keys <= page, schema
        assert page == keys or not whole, schema
        assert inside <= set(re.findall(r"[\w.]*\w", part(number).replace("[]", " "))) | split_keys(number), schema


def split_keys(number: str) -> set[str]:
    """Names that the keys of a section consist of; a key of a list's entries begins with none."""
    return {piece for key in keyed(number) for piece in re.split(r"\[\]\.|\.", key) if piece}


def test_no_key_of_an_answer_is_made_up():
    paths = [path for package in (*PACKAGES, "benchmarks") for path in (ROOT / package).rglob("*.py")]
    said = "\n".join(path.read_text(encoding="utf-8") for path in paths)
    words = {*re.findall(r"\w+", said), *re.findall(r'"([^"\n]+)"', said), "*", "JOINT", "NAME"}
    numbers = {row["section"] for row in (*rows("6.2"), *rows("6.3"))} | {"[6.10]", "[10]"}
    for number in {re.match(r"\[([\d.]+)\]", link)[1] for link in numbers}:
        assert split_keys(number) <= words, f"section {number}: {split_keys(number) - words}"


def paths_of(value, page: set[str], at: str = "") -> set[str]:
    """Paths of an answer's values, as far as the page goes into it; an empty list or mapping ends in `?`."""
    if at in page:
        return {at}
    if isinstance(value, dict) and value:
        return set().union(*(paths_of(inside, page, f"{at}.{key}".strip(".")) for key, inside in value.items()))
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return set().union(*(paths_of(inside, page, f"{at}[]") for inside in value))
    return {at if value or isinstance(value, int | float) else f"{at}?"}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with a model, poses, a recording and two records."""
    folder, arm = tmp_path_factory.mktemp("formats"), load_arm("sarcos")
    (folder / "q.csv").write_text("q_1,q_2\n0,1\n0.5,0.2\n")
    (folder / "run.csv").write_text("t,q_1,tau_1\n0,0.1,2\n0.01,0.2,2.5\n")
    link = "<body pos='0.4 0 0'><joint axis='0 1 0'/><geom size='0.1' pos='0.2 0 0'/>"
    (folder / "arm.xml").write_text(f"<mujoco><worldbody>{link}{link}</body></body></worldbody></mujoco>")
    for file, gain in (("a.yaml", 1.0), ("b.yaml", 1.01)):
        pair = {"gain": gain, "offset": 0.1, "position_gain": 1.0, "position_offset": 0.0}
        mine = {"arm": arm.name, "serial": arm.serial, "description_hash": arm.description_hash}
        joints = [{"name": name, **pair} for name in arm.joint_names]
        rest = {"created": "2026-01-02T03:04:05Z", "software": "test", "sources": {"data": "0"}, "joints": joints}
        (folder / file).write_text(CalibrationRecord.model_validate({**mine, **rest}).to_yaml())
    return folder


@pytest.mark.parametrize(
    ("number", "command"),
    [
        ("6.4", "scan sarcos"),
        ("6.5", "monitor sarcos --once --sync --stats"),
        ("6.6", "check sarcos --passive"),
        ("6.8", "convert run.csv other.csv"),
        ("6.8", "replay sarcos run.csv other.csv"),
        ("6.9", "sweep sarcos --plan --picture plan.html"),
        ("6.15", "torque arm.xml --q q.csv"),
        ("6.17", "history sarcos --store records.db --import a.yaml --activate"),
        ("6.18", "diff a.yaml b.yaml --store records.db"),
        ("6.24", "drives"),
        ("6.19", "gap plan sarcos --joint joint_2 --poses 1 --out motion.csv"),
    ],
)
def test_answers_as_they_are_written(number, command, workplace, monkeypatch, capsys):
    monkeypatch.chdir(workplace)
    assert cli.run([*command.split(), "--json", "answer.json"]) == 0, capsys.readouterr().err
    page = set(keyed(number))
    if number == "6.9":
        page |= {key.removeprefix("plan.") for key in keyed("3.3") if key.startswith("plan.")} - {"sweeps"}
    page -= {key.removeprefix("plan.") for key, row in keyed("3.3").items() if "left out" in row["meaning"]}
    written = paths_of(json.loads((workplace / "answer.json").read_text()), page)
    empty = tuple(path.rstrip("?") for path in written if path.endswith("?"))
    assert {path for path in written if not path.endswith("?")} <= page
    assert {path for path in page - written if not (empty and path.startswith(empty))} == set()
