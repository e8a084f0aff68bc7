"""After Ctrl-C or a stall it is said how the joints were left and how to go on."""

import pytest

from armlink.arm_file import load_arm
from armlink.commands.early_end import HOLD, PARKED, early_end
from armlink.errors import BadInput, BusFault, HostLate, Silence

RESUME = "armlink sweep sarcos --resume --out unloaded"


def ended(arm: str, error: BaseException, enabled: bool = True) -> None:
    def work() -> None:
        with early_end(load_arm(arm), RESUME) as work:
            work.enabled = enabled
            raise error

    with pytest.raises(type(error)):
        work()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), HostLate(0.18, 0.1), Silence("no joint answers")])
@pytest.mark.parametrize(("arm", "state"), [("sarcos", HOLD), ("six-moteus", PARKED), ("openarm", PARKED)])
def test_an_early_end_tells_the_state_of_the_joints_and_the_next_command(arm, state, error, capsys):
    ended(arm, error)
    assert capsys.readouterr().err.splitlines() == [f"{load_arm(arm).name}: {state}", f"next: {RESUME}"]


def test_joints_that_were_never_enabled_are_not_said_to_hold(capsys):
    ended("sarcos", KeyboardInterrupt(), enabled=False)
    assert capsys.readouterr().err == f"next: {RESUME}\n"


@pytest.mark.parametrize("error", [BusFault("joint_3 has a fault"), BadInput("no such file")])
def test_other_errors_speak_for_themselves(error, capsys):
    ended("sarcos", error)
    assert capsys.readouterr().err == ""
