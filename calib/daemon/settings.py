"""The arm file's section `daemon`, read again at SIGHUP, and the configuration in use."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field, FiniteFloat, field_validator

from armlink.arm_file import ArmFile, Positive, Section
from calib.observer.config import ObserverConfig, Policy

_WHOLE = frozenset(field.name for field in fields(ObserverConfig) if field.type == "int" or field.type is int)


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
    observer: dict[str, FiniteFloat] = Field(default_factory=dict)
    """Thresholds of the observer (calib/observer/config.py) that differ from their defaults."""

    @field_validator("observer")
    @classmethod
    def _known(cls, given: dict[str, float]) -> dict[str, float]:
        known = [field.name for field in fields(ObserverConfig)]
        for name in given:
            if name not in known:
                raise ValueError(f"there is no threshold {name!r}; there are {', '.join(known)}")
        for name, value in given.items():
            if value < (1 if name in _WHOLE else 0):
                least = "a whole number of at least 1" if name in _WHOLE else "a number of at least 0"
                raise ValueError(f"threshold {name} is {value:g}, expected {least}")
        return given

    def observer_config(self) -> ObserverConfig:
        """The observer's thresholds; integers stay integers."""
        return ObserverConfig(
            **{name: int(value) if name in _WHOLE else value for name, value in self.observer.items()}  # type: ignore[arg-type]
        )


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
