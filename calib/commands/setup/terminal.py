"""Questions of `armlink new` to a person at a terminal, and answers from its options."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from typer import BadParameter

from armlink.commands.plain_console import PlainConsole, ask, confirm
from armlink.errors import BadInput

if TYPE_CHECKING:
    from rich.console import Console

    from calib.commissioning.chain import Chain, ModelJoint
    from calib.commissioning.drive_match import Ask


def _numbers(
    option: str, texts: Sequence[str], count: int, holds: Callable[..., bool], expected: str
) -> dict[str, list[float]]:
    """Numbers by joint from texts JOINT:NUMBER…, so many of them, for which `holds`; raises BadInput."""
    found = {}
    for text in texts:
        joint, *words = text.rsplit(":", count)
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if not joint or len(numbers) != count or not holds(*numbers):
            raise BadInput(f"{option} {text}: expected {expected}")
        found[joint] = numbers
    return found


def parse_stops(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Stops [rad] by joint from texts JOINT:LOWER:UPPER; raises BadInput."""
    expected = "JOINT:LOWER:UPPER in rad, such as elbow:-2.1:2.1"
    found = _numbers("--stops", texts, 2, lambda low, high: low < high, expected)
    return {joint: (low, high) for joint, (low, high) in found.items()}


def parse_ratings(texts: Sequence[str]) -> dict[str, float]:
    """Rated torques [N·m] by joint from texts JOINT:TORQUE; raises BadInput."""
    expected = "JOINT:TORQUE in N·m, such as elbow:27"
    found = _numbers("--rated-torque", texts, 1, lambda torque: 0 < torque < math.inf, expected)
    return {joint: torque for joint, (torque,) in found.items()}


def parse_locks(texts: Sequence[str]) -> dict[str, float]:
    """Positions [rad, m] by joint from texts JOINT or JOINT:POSITION; raises BadInput."""
    given = [text if ":" in text else f"{text}:0" for text in texts]
    found = _numbers("--lock", given, 1, math.isfinite, "JOINT:POSITION in rad or m, such as lift:0.2")
    return {joint: position for joint, (position,) in found.items()}


def hand(by_hand: bool | None, interactive: bool) -> "Ask | None":
    """The function that asks a person to turn a joint; None if drives are taken in order. Raises BadInput."""
    if by_hand and not interactive:
        raise BadInput(
            "--by-hand needs a terminal for its questions: run the command on a terminal, or leave `--by-hand` out"
        )
    if by_hand is None and interactive:
        by_hand = confirm("Find each joint's drive by turning the joint by hand?", abort=False, default=True)
    if not by_hand:
        return None
    PlainConsole().print("The motors must have no power: release the brakes, and hold the arm.")
    return lambda text: ask(f"{text}, then press Enter", default="", show_default=False)


class Terminal:
    def __init__(self, console: "Console") -> None:
        self._console = console

    def which(self, chains: "Sequence[Chain]") -> "Chain":
        for number, chain in enumerate(chains, start=1):
            names = ", ".join(joint.name for joint in chain.joints)
            self._console.print(f"{number}: the arm that ends in {chain.tip}, with the joints {names}")
        numbered = {str(number): chain for number, chain in enumerate(chains, start=1)}

        def chosen(text: str) -> "Chain":
            if text.strip() not in numbered:
                raise BadParameter(f"{text}: expected a number from 1 to {len(chains)}")
            return numbered[text.strip()]

        answer: Chain = ask("The model has several arms. Which arm?", default="1", value_proc=chosen)
        return answer

    def stops(self, joint: "ModelJoint") -> tuple[float, float] | None:
        """Asked again until the answer can be read: what was answered before is not lost."""
        from calib.commissioning.draft import ASSUMED_STOP

        question = (
            f"{joint.name} has {joint.limits_in_words} in the model. Give its lower and upper stop [rad], such as "
            f"-2.1 2.1, or Enter if it has none: then it turns by at most {ASSUMED_STOP} rad to either side, and "
            "joints are held by their position loops"
        )
        given: tuple[float, float] | None = ask(question, default="", show_default=False, value_proc=_two_stops)
        return given


def _two_stops(text: str) -> tuple[float, float] | None:
    """An answer of two numbers; None for an empty one."""
    if not text.strip():
        return None
    try:
        return parse_stops([f"joint:{':'.join(text.replace(',', ' ').split())}"])["joint"]
    except BadInput:
        raise BadParameter(f"{text}: expected two numbers, the lower first") from None
