"""Whatever a driver of python-can raises is one line, and a fault of the bus or of what was asked of it."""

import ctypes
import errno
import struct
from collections.abc import Callable

import can
import pytest
from can.exceptions import CanInitializationError, CanInterfaceNotImplementedError, CanOperationError

from armlink.arm_file import Bus
from armlink.bus.adapters import PythonCanBus
from armlink.bus.message_port import MessagePort
from armlink.bus.open import open_bus
from armlink.bus.port import interface_fault
from armlink.bus.taps import TappedBus
from armlink.cli import run
from armlink.errors import ArmlinkError, BusFault

ERRORS = [
    CanInitializationError("no channel"),
    CanOperationError("the\nadapter is gone"),
    CanInterfaceNotImplementedError("no library"),
    OSError(19, "No such device"),
    OSError("without a number"),
    ValueError("bit rate 7 is not supported"),
    TypeError("__init__() got an unexpected keyword argument 'speed'"),
    ImportError("No module named 'usb'"),
    NameError("name 'canGetNumberOfChannels' is not defined"),
    AttributeError("'NoneType' object has no attribute 'write'"),
    NotImplementedError(),
    KeyError("timing"),
    RuntimeError("thread cannot be started"),
    struct.error("unpack requires a buffer of 16 bytes"),
    ctypes.ArgumentError("argument 1: wrong type"),
    AssertionError(),
]


class FailingBus(can.BusABC):
    """An interface whose driver raises."""

    channel_info = "failing"

    def __init__(self, error: Exception) -> None:
        self._error = error

    def send(self, msg, timeout=None):
        raise self._error

    def recv(self, timeout=None):
        raise self._error

    def shutdown(self):
        raise self._error

    def __del__(self):
        pass


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_opening_is_one_line(monkeypatch, error):
    def fail(**_):
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(ArmlinkError, match=r"^bus pcan:0: ") as caught:
        open_bus("pcan:0", Bus())
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) > len("bus pcan:0: cannot open it: ")


def test_a_kernel_without_socketcan_is_told_the_command_that_brings_it():
    fault = interface_fault(OSError(errno.EAFNOSUPPORT, "Address family not supported"), "socketcan:can0", "open it")
    assert str(fault).endswith(": this kernel has no SocketCAN: load its module with `sudo modprobe can`")


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("act", ["send", "receive", "listen", "tap"])
def test_sending_and_receiving_are_one_line(error, act):
    adapter = PythonCanBus(FailingBus(error), "pcan:0")
    port = MessagePort(adapter.bus, "pcan:0")
    acts: dict[str, Callable[[], object]] = {
        "send": lambda: port.send(0x80, b""),
        "receive": lambda: port.receive(0.0),
        "listen": lambda: adapter.recv(0.0),
        "tap": lambda: TappedBus(adapter, lambda message, stamp: None).take(),
    }
    with pytest.raises(BusFault, match=r"^bus pcan:0: cannot (send|receive): ") as caught:
        acts[act]()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_while_closing_hides_no_other(error):
    PythonCanBus(FailingBus(error), "pcan:0").shutdown()


@pytest.mark.parametrize("interface", sorted(set(can.VALID_INTERFACES) - {"armlink_sim", "virtual", "socketcand"}))
def test_an_interface_without_its_driver_is_one_line(interface, capsys):
    """Each of python-can's, as it is on this machine; nothing of its driver's own talk reaches the terminal."""
    assert run(["scan", "--bus", f"{interface}:none"]) in (2, 3)
    error = capsys.readouterr().err
    assert error.startswith(f"armlink: bus {interface}:none: ")
    assert error.count("\n") == 1
