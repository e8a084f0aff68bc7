"""The rule by which the parts of the observer are saved: JSON values, read back whole or not at all.

Every part has `save() -> dict` and `restore(values) -> bool`; `restore` returns False and changes nothing if the values
do not fit. Times are not saved, because clocks restart with the machine.
"""

UNREADABLE = (LookupError, TypeError, ValueError, OverflowError)
"""Raised while values are read that are missing, of another type or of another shape (BadArray is a ValueError)."""
