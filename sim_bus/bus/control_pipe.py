"""Changing a simulated arm while it runs, from any other process: lines of text through a named pipe.

| line | does |
|---|---|
| `effect ID:JOINT:VALUE` | adds an imperfection to those there are |
| `effects none` | takes all imperfections away, those of the arm file too |
| `drift JOINT:GAIN:OFFSET` | changes a torque sensor from now on |
| `fault ID:JOINT:VALUE` | injects a fault |
| `faults none` | ends all faults |
| `mass KG`, `mass 0` | bolts a mass to the flange, takes it off |
"""

import os
import stat
from pathlib import Path

from armlink.errors import ArmlinkError, BadInput
from sim_bus.bus.effect_options import parse_drift, parse_effect
from sim_bus.bus.fault_injector import Injector
from sim_bus.bus.fault_kinds import parse_fault

WORDS = "effect ID:JOINT:VALUE, effects none, drift JOINT:GAIN:OFFSET, fault ID:JOINT:VALUE, faults none or mass KG"


def obey(line: str, injector: Injector) -> None:
    """Do what one line says. Raises BadInput."""
    arm, (word, _, text) = injector.arm, line.strip().partition(" ")
    text = text.strip()
    if word == "effect":
        arm.set_effects([*arm.effects, parse_effect(text, arm.names)])
    elif (word, text) == ("effects", "none"):
        arm.set_effects([])
    elif word == "drift":
        change = parse_drift(f"{text}@0", arm.names)
        arm.drift(change.joint, change.gain, change.offset)
    elif word == "fault":
        injector.inject(parse_fault(text, arm.names))
    elif (word, text) == ("faults", "none"):
        injector.clear()
    elif word == "mass":
        arm.attach_mass(_mass(text))
    else:
        raise BadInput(f"{line.strip()!r}: expected {WORDS}")


def _mass(text: str) -> float:
    try:
        mass = float(text)
        if not 0.0 <= mass < float("inf"):
            raise ValueError
    except ValueError:
        raise BadInput(f"mass {text!r}: expected a number of kilograms, 0 or more") from None
    return mass


class ControlPipe:
    """A named pipe whose lines are obeyed; what cannot be is returned in words, and the arm runs on."""

    def __init__(self, path: Path) -> None:
        """Make the pipe, or take one that is there. Raises BadInput where the path is something else."""
        self.path = path
        try:
            if not path.exists():
                os.mkfifo(path, 0o600)
                self._made = True
            else:
                self._made = False
            if not stat.S_ISFIFO(path.stat().st_mode):
                raise BadInput(f"--control {path}: is no named pipe: give a path that does not exist yet")
            self._file = os.open(path, os.O_RDWR | os.O_NONBLOCK)  # written to as well, so that it never ends
        except OSError as error:
            raise BadInput(f"--control {path}: {error.strerror}") from None
        self._rest = b""

    def poll(self, injector: Injector) -> list[str]:
        """Obey the lines that have come; what was wrong with them."""
        try:
            self._rest += os.read(self._file, 65536)
        except BlockingIOError:
            return []
        *lines, self._rest = self._rest.split(b"\n")
        wrong = []
        for line in lines:
            if line.strip():
                try:
                    obey(line.decode(errors="replace"), injector)
                except ArmlinkError as error:
                    wrong.append(str(error))
        return wrong

    def close(self) -> None:
        """Close the pipe; one that was made goes away."""
        os.close(self._file)
        if self._made:
            self.path.unlink(missing_ok=True)
