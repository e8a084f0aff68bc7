"""Array types, and the checks that public functions make of their arguments."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gcomp.errors import BadArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def as_array(name: str, value: ArrayLike, shape: tuple[int | None, ...], finite: bool = True) -> Array:
    """`value` as float64 of a given shape (None: any length); raises BadArray naming `name` if it is not."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadArray(f"{name} must be an array of numbers") from None
    fits = array.ndim == len(shape) and all(w is None or w == g for w, g in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("K" if w is None else str(w) for w in shape)
        raise BadArray(f"{name} has shape {array.shape}, expected ({wanted})")
    if finite and not np.isfinite(array).all():
        where = tuple(int(index) for index in np.argwhere(~np.isfinite(array))[0])
        raise BadArray(f"{name}{list(where)} is {array[where]}, expected finite numbers")
    return array


def as_poses(name: str, value: ArrayLike, n: int) -> tuple[Array, tuple[int, ...]]:
    """Joint positions (…, n) as (K, n), and the leading shape; raises BadArray if the last axis is not n."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != n:
        raise BadArray(f"{name} has shape {array.shape}, expected (…, {n}): one position per joint")
    return array.reshape(-1, n), array.shape[:-1]


def as_batch(array: Array, leading: tuple[int, ...]) -> Array:
    """An array (K, …) in the leading shape of the poses."""
    batch: Array = array.reshape(*leading, *array.shape[1:])
    return batch


def joined(parts: Sequence[T]) -> T:
    """One dataclass of arrays from the rows of several, one after the other; dataclasses in it likewise."""
    kind = type(parts[0])
    columns = ([getattr(part, each.name) for part in parts] for each in fields(kind))
    whole = (joined(column) if is_dataclass(column[0]) else np.concatenate(column) for column in columns)
    return kind(*whole)


def cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; numpy's own is several times slower on short arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = ay * bz - az * by
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def frozen(instance: Any, **fields: Any) -> None:
    """Set fields of a frozen dataclass from its __post_init__; arrays become read-only."""
    for name, value in fields.items():
        if isinstance(value, np.ndarray):
            value = value.copy()
            value.setflags(write=False)
        object.__setattr__(instance, name, value)
