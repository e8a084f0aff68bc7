"""Faults of a python-can interface. Its driver is anybody's code: whatever it raises is a fault of the bus."""

import errno
import logging

from armlink.bus.port import InterfaceDown
from armlink.errors import ArmlinkError, BusFault

logging.getLogger("can").addHandler(logging.NullHandler())  # else what it logs goes to standard error, unasked


def interface_fault(error: Exception, name: str, doing: str) -> ArmlinkError:
    """The exception for an error of an interface while `doing` something on the bus `name`; our own errors stay."""
    if isinstance(error, ArmlinkError):
        return error
    down = errno.ENETDOWN in (getattr(error, "error_code", None), getattr(error, "errno", None))
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    if isinstance(error, NameError | AttributeError | ImportError):  # its library is missed this late
        reason = f"{reason}: is the interface's driver installed?"
    return (InterfaceDown if down else BusFault)(f"bus {name}: cannot {doing}: {reason}")
