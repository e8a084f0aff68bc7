"""Effects and drifts as given on the command line."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from armlink.errors import BadInput
from armlink.key_errors import describe
from sim_bus.effects.registry import effects
from sim_bus.sim_section import EffectEntry

EFFECT_FORM = "ID:JOINT:VALUE[,VALUE…] or ID:JOINT:NAME=VALUE[,…], for example friction.coulomb:joint_2:1.5"
DRIFT_FORM = "JOINT:GAIN:OFFSET@T, for example joint_3:1.03:0.3@20"


@dataclass(frozen=True)
class SensorDrift:
    """A change of one joint's torque sensor."""

    joint: str
    gain: float
    offset: float
    """Added to the offset [N·m]."""
    time: float
    """Time of the change [s]."""


def parse_effect(text: str, joints: Sequence[str]) -> list[EffectEntry]:
    """Parse one `--effect`; values without names are its parameters in order. Raises BadInput.

    Without a joint it is an effect of the whole arm, or one of every joint.
    """
    effect_id, colon, rest = text.partition(":")
    joint, second, values = rest.partition(":")
    if not (colon and second and effect_id and values):
        raise BadInput(f"--effect {text!r}: expected {EFFECT_FORM}")
    if effect_id not in effects():
        raise BadInput(f"--effect {text!r}: there is no effect {effect_id!r}; expected one of {', '.join(effects())}")
    if joint and joint not in joints:
        raise BadInput(f"--effect {text!r}: there is no joint {joint!r}; expected one of {', '.join(joints)}")
    given: dict[str, Any] = {"effect": effect_id, **_parameters(text, effect_id, values.split(","))}
    named = [joint] if joint else joints if effects()[effect_id].per_joint else []
    try:
        return [EffectEntry.model_validate(given | {"joint": each}) for each in named] or [
            EffectEntry.model_validate(given)
        ]
    except ValidationError as error:
        raise BadInput(f"--effect {text!r}: {describe(error)}") from None


def _parameters(text: str, effect_id: str, items: list[str]) -> dict[str, Any]:
    """Parameters by name; values without names are assigned in order, several to a vector."""
    if all("=" in item for item in items):
        return {name: _value(text, value) for name, _, value in (item.partition("=") for item in items)}
    found: dict[str, Any] = {}
    remaining = [_value(text, item) for item in items]
    for parameter in effects()[effect_id].parameters:
        if not remaining:
            break
        size = parameter.sizes[0]
        found[parameter.name] = remaining[:size] if size else remaining[0]
        remaining = remaining[max(size, 1) :]
    if remaining:
        raise BadInput(f"--effect {text!r}: {len(remaining)} values too many; expected {EFFECT_FORM}")
    return found


def _value(text: str, item: str) -> float | str:
    try:
        return float(item)
    except ValueError:
        if item.isidentifier():
            return item
        raise BadInput(f"--effect {text!r}: value {item!r} is not a number; expected {EFFECT_FORM}") from None


def parse_drift(text: str, joints: Sequence[str]) -> SensorDrift:
    change, at, time = text.partition("@")
    parts = change.split(":")
    try:
        if not at or len(parts) != 3:
            raise ValueError
        drift = SensorDrift(parts[0], float(parts[1]), float(parts[2]), float(time))
    except ValueError:
        raise BadInput(f"--drift {text!r}: expected {DRIFT_FORM}") from None
    if drift.joint not in joints:
        raise BadInput(f"--drift {text!r}: there is no joint {drift.joint!r}; the joints are {', '.join(joints)}")
    if drift.gain == 0.0:
        raise BadInput(f"--drift {text!r}: a gain factor of 0 would remove the signal; expected {DRIFT_FORM}")
    return drift
