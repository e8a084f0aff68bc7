"""No number of an arm file may be infinite: a limit that is infinite is switched off."""

import math
from collections.abc import Iterator
from typing import Annotated, Any

import pytest
from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from armlink.arm_file import LinkJoint, LinkSection, Section
from armlink.drives.family import family, family_names
from calib.arm.sweep_section import SweepSection
from calib.daemon.settings import DaemonSection, RecordingSettings
from sim_bus.sim_section import SimSection

FAMILIES = tuple(family(name).settings for name in family_names())
KNOWN = (LinkJoint, LinkSection, SweepSection, DaemonSection, RecordingSettings, SimSection, *FAMILIES)


def kinds(base: type[Section]) -> Iterator[type[Section]]:
    for kind in base.__subclasses__():
        yield kind
        yield from kinds(kind)


def fields() -> Iterator[tuple[str, FieldInfo]]:
    for kind in kinds(Section):
        if kind.__module__.split(".")[0] in ("armlink", "calib", "sim_bus", "sim_gap"):
            for name, field in kind.model_fields.items():
                if field.annotation is not Any:  # a section of another package, which is among the kinds itself
                    yield f"{kind.__name__}.{name}", field


def accepts(field: FieldInfo, value: Any) -> bool:
    try:
        TypeAdapter(Annotated[field.annotation, "", *field.metadata]).validate_python(value)
    except (ValidationError, ValueError):
        return False
    return True


def shapes(value: float) -> Iterator[Any]:
    """A number wherever a field may hold one: alone, in a list, by name."""
    yield value
    for count in range(1, 7):
        yield (value,) * count
    yield {"window": value}


NUMBERS = {name: field for name, field in fields() if any(accepts(field, shape) for shape in shapes(0.5))}


def test_the_numbers_of_all_sections_are_found() -> None:
    assert all(
        any(name.startswith(f"{kind.__name__}.") for name in NUMBERS) for kind in KNOWN if kind is not SimSection
    )
    assert {"LinkJoint.max_velocity", "LinkJoint.max_torque_rate", "ObserverConfig.still_band"} <= set(NUMBERS)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_no_number_of_an_arm_file_may_be_infinite(value: float) -> None:
    assert [name for name, field in NUMBERS.items() if any(accepts(field, shape) for shape in shapes(value))] == []
