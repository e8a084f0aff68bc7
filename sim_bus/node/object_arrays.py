"""PDO-mappable objects of all joints, one array per object, for the cyclic path."""

from functools import cache
from typing import Any

import canopen
import numpy as np
from canopen.objectdictionary import ODArray, ODVariable
from numpy.typing import NDArray

from armlink.drives.canopen.eds_file import bundled_path

DTYPES = {0x02: "<i1", 0x03: "<i2", 0x04: "<i4", 0x05: "<u1", 0x06: "<u2", 0x07: "<u4", 0x08: "<f4"}
"""numpy types of CiA 301 data types."""
Key = tuple[int, int]
INPUT = 0x3160
"""Analog inputs of a stock device; a joint torque sensor may be wired to the first."""


@cache
def data_sheet() -> canopen.ObjectDictionary:
    """The joint's EDS for node id 0 and what stock devices have besides; entries with `relative` add the node's id."""
    sheet = canopen.import_od(bundled_path(), node_id=0)
    inputs = ODArray("analog inputs", INPUT)
    for sub, kind in ((0, 0x05), (1, 0x03)):
        inputs.add_member(_entry(f"analog input {sub}", INPUT, sub, kind, pdo_mappable=bool(sub)))
    sheet.add_object(inputs)
    for index, name in ((0x60A8, "SI unit position"), (0x60A9, "SI unit velocity")):
        if index not in sheet:
            sheet.add_object(_entry(name, index, 0, 0x07))
    return sheet


def _entry(name: str, index: int, sub: int, kind: int, pdo_mappable: bool = False) -> ODVariable:
    entry = ODVariable(name, index, sub)
    entry.data_type, entry.access_type, entry.default, entry.pdo_mappable = kind, "ro", 0, pdo_mappable
    return entry


def variable(index: int, sub: int) -> ODVariable | None:
    item = data_sheet().get(index)
    if item is None or isinstance(item, ODVariable):
        return item if sub == 0 else None
    try:
        return item.subindices[sub]
    except KeyError:
        return None


class ObjectArrays:
    """`values[index, sub]` is an (n,) array of the object's type; the arrays are never replaced."""

    def __init__(self, n: int) -> None:
        entries = [
            entry
            for item in data_sheet().values()
            for entry in ([item] if isinstance(item, ODVariable) else item.subindices.values())
            if entry.pdo_mappable
        ]
        self.values: dict[Key, NDArray[Any]] = {
            (entry.index, entry.subindex): np.full(n, entry.default or 0, DTYPES[entry.data_type]) for entry in entries
        }

    def __getitem__(self, key: Key) -> NDArray[Any]:
        return self.values[key]

    def __contains__(self, key: Key) -> bool:
        return key in self.values
