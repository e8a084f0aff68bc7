"""Faults of the command line: joint and value, or the kind's own."""

import math

import pytest

from sim_bus.bus.fault_kinds import ALL_KINDS, parse_fault


@pytest.mark.parametrize("kind", ALL_KINDS.values(), ids=lambda kind: kind.id)
def test_a_fault_without_a_value_has_that_of_its_kind(kind):
    text = f"{kind.id}:hinge" if kind.per_joint else kind.id
    fault = parse_fault(f"{text}@2.5", ["hinge"])
    assert (fault.kind, fault.joint, fault.time) == (kind, "hinge" if kind.per_joint else "", 2.5)
    assert math.isnan(fault.value)
    assert fault.amount == kind.default or (math.isnan(fault.amount) and math.isnan(kind.default))
    if kind.value:
        given = parse_fault(f"{text}:0.5" if kind.per_joint else f"{text}::0.5", ["hinge"])
        assert (given.amount, given.time) == (0.5, 0.0)
