"""Command-line options; light to import, so that the bus process starts before the rest is loaded."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armlink.arm_file import ArmFile
from calib.daemon.loop.loop_messages import LoopOptions
from calib.daemon.settings import DaemonSection, daemon_section
from calib.observer.config import Policy


@dataclass(frozen=True)
class Options:
    """Options of `armlink daemon`."""

    arm: str
    bus: str | None = None
    listen_only: bool = False
    socket: Path | None = None
    tcp: tuple[str, int] | None = None
    token: str | None = None
    policy: Policy | None = None
    store: str | None = None
    work: bool = False

    def settings(self, arm: ArmFile) -> DaemonSection:
        """The arm file's section, overridden by the command line."""
        given: dict[str, Any] = {} if self.policy is None else {"policy": self.policy}
        if self.work:
            given["work"] = True
        return daemon_section(arm).model_copy(update=given)

    def loop(self, arm: ArmFile) -> LoopOptions:
        return LoopOptions(arm, self.bus, self.listen_only, work=self.settings(arm).work, seed=int(time.time()))


def state_directory(given: Path | None, arm: ArmFile) -> Path:
    """Directory of journal and recordings: --state, else systemd's STATE_DIRECTORY, else the user's state directory."""
    if given is not None:
        return given
    of_systemd = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    user = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "armlink"
    return Path(of_systemd or user) / "daemon" / f"{arm.name}-{arm.serial}"
