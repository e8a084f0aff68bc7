"""docs/formats.md holds to the code: keys with type, range, unit and default, channels, effects, records."""

import ast
import inspect
import itertools
import json
import re
from importlib.metadata import entry_points

import pytest
from pydantic import TypeAdapter

from armlink.arm_file import ArmFile
from armlink.recording.files import SUFFIXES
from armlink.recording.mcap import TOPICS
from armlink.recording.recording import COLUMNS, Recording
from calib.dataset import Manifest, PlanLine, StallLine
from calib.motion.static_reading import StaticReading
from calib.records.records import ArmRecord, CalibrationRecord, GravityRecord
from sim_bus.effects.registry import NOT_SIMULATED
from sim_bus.effects.registry import effects as forward_effects
from sim_gap.effects.registry import LAWS
from sim_gap.effects.registry import effects as inverse_effects
from tests.house.conftest import keyed, part, rows

NOTHING = "–"
SECTIONS = {point.name: point.load() for point in entry_points(group="armlink.sections")}


# ---- models of pydantic


def plain(value):
    """A value as the page writes it: 250, not 250.0."""
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def coded(value) -> str:
    return f"`{json.dumps(plain(value), ensure_ascii=False)}`"


def variants(schema: dict) -> list[dict]:
    return [each for each in schema.get("anyOf", [schema]) if each.get("type") != "null"]


def type_of(schema: dict) -> str:
    names = []
    for each in variants(schema):
        name = "mapping" if "$ref" in each else each.get("type", "mapping").replace("object", "mapping")
        if name == "array":
            inside = type_of(each["items"] if "items" in each else each["prefixItems"][0])
            inside = f"lists{inside.removeprefix('list')}" if inside.startswith("list ") else f"{inside}s"
            least, most = each.get("minItems"), each.get("maxItems")
            name = f"{least} {inside}" if most and most == least else f"{least} to {most} {inside}"
            name = name if most else f"list of {inside}"
        names.append(name)
    names += ["null"] * any(each.get("type") == "null" for each in schema.get("anyOf", ()))
    return " or ".join(dict.fromkeys(names))


def range_of(schema: dict) -> str:
    schema = variants(schema)[0]
    if schema.get("type") == "array" and "items" in schema:
        return range_of(schema["items"])
    if "enum" in schema:
        return ", ".join(f"`{each}`" for each in schema["enum"])
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [f"{sign} {plain(schema[name])}" for name, sign in signs.items() if name in schema]
    return ", ".join(limits) or NOTHING


def nested(schema: dict) -> tuple[str, str] | None:
    """Name of the model that a key holds, and what joins both keys; None if it holds none."""
    for each in variants(schema):
        for inside, between in ((each, "."), (each.get("items"), "[]."), (each.get("additionalProperties"), ".*.")):
            if isinstance(inside, dict) and "$ref" in inside:
                return inside["$ref"].rpartition("/")[2], between
    return None


def keys_of(schema: dict, at: str = "", all_of: dict | None = None, seen: set[str] | None = None):
    """Key → (type, range, default) of a JSON schema and all that it holds; each model is listed once."""
    all_of, seen = schema.get("$defs", {}) if all_of is None else all_of, set() if seen is None else seen
    found = {}
    for name, value in schema["properties"].items():
        default = "required" if name in schema.get("required", ()) else coded(value.get("default", {}))
        default = "see its keys" if "$ref" in value and default != "required" else default
        found[at + name] = (type_of(value), range_of(value), default)
        model, between = nested(value) or ("", "")
        if model and model not in seen:
            seen.add(model)
            found |= keys_of(all_of[model], f"{at}{name}{between}", all_of, seen)
    return found


def arm_file_keys() -> dict[str, tuple[str, str, str]]:
    """Every key of the arm file, those of the packages' sections included."""
    found = keys_of(ArmFile.model_json_schema())
    del found["path"]  # where the file lies: no key of it
    for name, model in SECTIONS.items():
        found |= keys_of(model.model_json_schema(), f"{name}.")
    return found


def units_in_docstrings(model: type) -> dict[str, list[str]]:
    """Attribute → units in brackets in its docstring, if any."""
    body = ast.parse(inspect.getsource(model)).body[0].body
    found = {}
    for line, after in itertools.pairwise(body):
        text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and str(after.value.value)
        if isinstance(line, ast.AnnAssign) and text:
            found[line.target.id] = re.findall(r"\[([^\]]+)\]", text)
    return {name: units for name, units in found.items() if units}


def models_in(model: type):
    """A model and all that it holds."""
    yield model
    for field in model.model_fields.values():
        for inside in re.findall(r"[\w.]+", str(field.annotation)):
            module, _, name = inside.rpartition(".")
            found = getattr(inspect.getmodule(model), name, None)
            if module and inspect.isclass(found) and hasattr(found, "model_fields") and found is not model:
                yield from models_in(found)


def compare(page: dict[str, dict[str, str]], code: dict[str, tuple[str, str, str]]) -> None:
    columns = ("type", "range", "default")
    for key in page.keys() & code.keys():
        given = {name: page[key][name] for name in columns if name in page[key]}
        assert given == {name: dict(zip(columns, code[key], strict=True))[name] for name in given}, key
    assert page.keys() - code.keys() == set(), "keys of the page that the code does not have"
    assert code.keys() - page.keys() == set(), "keys of the code that the page does not have"


def test_every_key_of_the_arm_file_with_type_range_and_default():
    compare(keyed("1"), arm_file_keys())


@pytest.mark.parametrize("model", [m for s in (ArmFile, *SECTIONS.values()) for m in models_in(s)])
def test_units_of_the_arm_file(model):
    for name, units in units_in_docstrings(model).items():
        given = {row["unit"] for key, row in keyed("1").items() if key.rpartition(".")[2] == name}
        assert given & set(units), f"{model.__name__}.{name}: {given} on the page, {units} in the code"


@pytest.mark.parametrize(
    ("number", "model", "common"),
    [
        ("3.1", Manifest, None),
        ("3.2", StaticReading, None),
        ("3.3", PlanLine, None),
        ("3.4", StallLine, None),
        ("4.1", ArmRecord, None),
        ("4.2", CalibrationRecord, ArmRecord),
        ("4.3", GravityRecord, ArmRecord),
    ],
)
def test_data_sets_and_records(number, model, common):
    code = keys_of(TypeAdapter(model).json_schema(mode="serialization"))
    for key in () if common is None else keys_of(common.model_json_schema()):
        del code[key]
    compare(keyed(number), code)


# ---- recordings and effects


def test_recording_channels_columns_units_and_topics():
    page = {row["channel"].strip("`"): row for row in rows("2.1")}
    units = units_in_docstrings(Recording)
    assert list(page) == ["time", *COLUMNS]
    for name, prefix in COLUMNS.items():
        lists = {topic: channels.index(name) for topic, channels in TOPICS.items() if name in channels}
        fields = [f"`{topic}` {('position', 'velocity', 'effort')[at]}" for topic, at in lists.items()]
        assert page[name]["column"] == f"`{prefix}_i`"
        assert page[name]["unit"] == units[name][0]
        assert page[name]["MCAP topic and field"] == ", ".join(fields)
    assert set(re.findall(r"`(\.[a-z.]+)`", part("2.2") + part("2.3"))) >= set(SUFFIXES)


def test_effects_with_their_parameters_and_units():
    page = {row["effect"].strip("`"): row for row in rows("5.1")}
    forward = forward_effects()
    inverse = {name: each for name, each in inverse_effects().items() if name not in {*LAWS, *NOT_SIMULATED}}
    assert page.keys() == forward.keys() == inverse.keys()
    for name, row in page.items():
        given = re.findall(r"`(\w+)` \[([^\]]+)\]([^,`]*)(?:, default `([^`]+)`)?", row["parameters"])
        assert [(parameter.name, parameter.unit) for parameter in forward[name].parameters] == [g[:2] for g in given]
        for parameter, (_, _, rest, default) in zip(forward[name].parameters, given, strict=True):
            sizes = " or ".join(str(size) for size in parameter.sizes if size)
            domain = parameter.domain
            low = f"≥ {domain.least:g}" if domain.least is not None else ""
            high = f"> {domain.above:g}" if domain.above is not None else ""
            assert rest.split() == f"{f'× {sizes}' if sizes else ''} {low}{high}".split(), name
            assert default == ("" if domain.default is None else f"{domain.default:g}"), name
        reported = re.findall(r"`(\w+)` \[([^\]]+)\]", row["reported by the diagnosis"])
        assert [*inverse[name].reported] == reported
        assert row["of"] == ("joint" if forward[name].per_joint else "arm")
        assert inverse[name].signature.whole_arm is not forward[name].per_joint
