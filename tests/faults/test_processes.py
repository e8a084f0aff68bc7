"""Host and arm as two processes on a bus without a kernel's help (udp_multicast): SIGKILL and SIGSTOP, a few times."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long  # the quick ones are in armlink/loop/test_remote_link.py and on SocketCAN

ROOT = Path(__file__).parent.parent.parent


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(["--tries", "3"], id="SIGKILL"),
        pytest.param(["--tries", "1", "--stop"], id="SIGSTOP"),
    ],
)
def test_a_host_that_dies_under_a_bias_torque_leaves_every_joint_safe(options: list[str]) -> None:
    campaign = ROOT / "tests" / "campaigns" / "kill_host.py"
    run = subprocess.run(
        [sys.executable, str(campaign), *options, "--slack", "5"], capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stdout + run.stderr
