"""The arm file's section `daemon`, read again at SIGHUP, the command line that overrides it, and what is in use."""

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, FiniteFloat, field_validator

from armlink.arm_file import ArmFile, Positive, Section
from armlink.loop.kept_arm import KeptArm
from calib.daemon.logs import log_to_stderr
from calib.daemon.view import Policy
from calib.observer.config import ObserverConfig

log = logging.getLogger("armlink.daemon")
FORMER_THRESHOLDS = frozenset({
    "agreement", "alarm_threshold", "audit_rows", "common_joints", "discrepancy_share", "drift_gain", "drift_offset",
    "evidence", "excitation_rows", "excitation_std", "gap_time", "initial_gain_std", "initial_offset_std",
    "lever_share", "longest_window", "misfit", "new_pose", "noise_memory", "noise_rows", "outlier", "outliers_in_a_row",
    "patience", "place_memory", "place_rows", "place_size", "places", "significance",
})  # fmt: skip
"""Keys that arm files of earlier versions may have: constants by now."""


class RecordingSettings(Section):
    """The daemon's own recordings (MCAP); the oldest are dropped first."""

    enabled: bool = True
    rate: Annotated[FiniteFloat, Field(gt=0, le=1000)] = 25.0
    """Rows per second [Hz], at most the SYNC rate."""
    minutes: Positive = 10.0
    """Length of one file [min]."""
    quota_mb: Positive = 2000.0
    """All files together [MB]."""


class DiagnosisSettings(Section):
    """The daemon's own diagnosis of the arm's recordings (`armlink gap trend`), by a process of its own."""

    enabled: bool = True
    hours: Positive = 24.0
    """Time from one to the next [h]."""
    travel: Positive = 10.0
    """Least path of all joints together in the minute that is diagnosed [rad]."""
    sim: Path | None = None
    """Nominal model: MJCF, URDF or arm file, a path from the arm file; by default the arm file itself."""


class DaemonSection(Section):
    """The arm file's section `daemon`; every key has a default."""

    policy: Policy = "propose"
    """Reaction to a drift: an event only, a proposal, or a new record written to the controller."""
    rest_between_writes: Positive = 600.0
    """At most one recalibration of a joint in this time [s]."""
    writes_per_day: Annotated[int, Field(ge=1)] = 24
    """Limit for recalibrations of the arm that the daemon decides on itself."""
    sweep_when_undecided: bool = False
    """Whether the daemon may sweep the arm if watching cannot decide; only if it drives the bus."""
    sweep_every_hours: Positive | None = None
    """Time between sweeps [h]; only if the daemon drives the bus."""
    work: bool = False
    """Whether the daemon, if it drives the bus, moves the arm among random poses, in place of ordinary work."""
    recording: RecordingSettings = RecordingSettings()
    diagnosis: DiagnosisSettings = DiagnosisSettings()
    observer: ObserverConfig = ObserverConfig()

    @field_validator("observer", mode="before")
    @classmethod
    def _without_former(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        for name in sorted(FORMER_THRESHOLDS & given.keys()):
            log.warning("daemon.observer.%s is an obsolete setting and is ignored", name)
        return {name: value for name, value in given.items() if name not in FORMER_THRESHOLDS}


def daemon_section(arm: ArmFile) -> DaemonSection:
    return arm.daemon if isinstance(arm.daemon, DaemonSection) else DaemonSection()


@dataclass
class Configuration:
    """Arm file, settings and mode in use. A reload replaces arm and settings; every part reads them here."""

    arm: ArmFile
    settings: DaemonSection
    listen_only: bool

    @property
    def names(self) -> tuple[str, ...]:
        return self.arm.joint_names


@dataclass(frozen=True)
class Options:
    arm: str
    socket: Path
    """Of API and page."""
    bus: str | None = None
    listen_only: bool = False
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

    def keep(self, arm: ArmFile, *inherits: int) -> KeptArm:
        """Start the process that keeps the arm open; it inherits these descriptors."""
        return KeptArm(arm, self.bus, self.listen_only, inherits, log_to_stderr)


def state_directory(given: Path | None, arm: ArmFile) -> Path:
    """Directory of journal and recordings: --state, else systemd's STATE_DIRECTORY, else the user's state directory."""
    if given is not None:
        return given
    of_systemd = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    user = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "armlink"
    return Path(of_systemd or user) / "daemon" / f"{arm.name}-{arm.serial}"
