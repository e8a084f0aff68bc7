"""Changes a running simulated arm from another process: lines of text through a named pipe.

| line | does |
|---|---|
| `effect ID:JOINT:VALUE` | adds an imperfection to those there are |
| `effects none` | removes all imperfections, those of the arm file too |
| `drift JOINT:GAIN:OFFSET` | changes a torque sensor from now on |
| `fault ID:JOINT:VALUE` | injects a fault |
| `faults none` | ends all faults |
| `mass KG`, `mass 0` | attaches a mass to the flange, removes it |
| `hand JOINT:ANGLE` | turns a joint without power to a true angle [rad], kept within its stops |
"""

import os
import stat
from pathlib import Path

from armlink.errors import ArmlinkError, BadInput
from sim_bus.bus.effect_options import parse_drift, parse_effect
from sim_bus.bus.fault_injector import Injector
from sim_bus.bus.fault_kinds import parse_fault

WORDS = (
    "effect ID:JOINT:VALUE, effects none, drift JOINT:GAIN:OFFSET, fault ID:JOINT:VALUE, faults none, mass KG or "
    "hand JOINT:ANGLE"
)


def obey(line: str, injector: Injector) -> None:
    arm, (word, _, text) = injector.arm, line.strip().partition(" ")
    text = text.strip()
    if word == "effect":
        arm.set_effects([*arm.effects, *parse_effect(text, arm.names)])
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
    elif word == "hand":
        arm.turn_by_hand(*_turn(text))
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


def _turn(text: str) -> tuple[str, float]:
    joint, colon, angle = text.rpartition(":")
    try:
        if not colon:
            raise ValueError
        return joint, float(angle)
    except ValueError:
        raise BadInput(f"hand {text!r}: expected JOINT:ANGLE in rad, for example: hand joint_2:0.5") from None


class ControlPipe:
    """A named pipe of commands; an invalid command is reported and the arm keeps running."""

    def __init__(self, path: Path) -> None:
        """Create the pipe, or use an existing one. Raises BadInput if the path is something else."""
        self.path = path
        try:
            if not path.exists():
                os.mkfifo(path, 0o600)
                self._made = True
            else:
                self._made = False
            if not stat.S_ISFIFO(path.stat().st_mode):
                raise BadInput(f"--control {path}: is not a named pipe: give a path that does not exist yet")
            self._file = os.open(
                path, os.O_RDWR | os.O_NONBLOCK
            )  # also open for writing, so that it never reaches its end
        except OSError as error:
            raise BadInput(f"--control {path}: {error.strerror}") from None
        self._rest = b""

    def poll(self, injector: Injector) -> list[str]:
        """Execute the lines received; returns each with `: done`, or what is wrong with it."""
        try:
            self._rest += os.read(self._file, 65536)
        except BlockingIOError:
            return []
        *lines, self._rest = self._rest.split(b"\n")
        answers = []
        for line in lines:
            if line.strip():
                text = line.decode(errors="replace")
                try:
                    obey(text, injector)
                    answers.append(f"{text.strip()}: done")
                except ArmlinkError as error:
                    answers.append(str(error))
        return answers

    def close(self) -> None:
        os.close(self._file)
        if self._made:
            self.path.unlink(missing_ok=True)
