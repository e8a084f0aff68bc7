"""A sweep plan: which joint moves when, where the others rest and what holds them there."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

Side = Literal[-1, 0, 1]
APPROACH = 0.03
"""Each step is approached over at least this way [rad]."""
SCOUT = "scout"
"""Name in data sets of the readings at a few poses, under position control, before the first sweep."""
SCOUT_ACCELERATION = 1.0
"""Of its ways: nothing is known of the arm's weight yet [rad/s²]."""
SCOUT_TITLE = "rough gravity model"
"""Their name for people: their purpose."""


def reading_name(sweep: str, index: int) -> str:
    """A reading for people: its sweep, or the rough gravity model, and its number."""
    return f"{SCOUT_TITLE}, pose {index + 1}" if sweep == SCOUT else f"{sweep}, reading {index + 1}"


class _PlanPart(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Sweep(_PlanPart):
    """One sweep: a joint steps through its range while the others rest."""

    name: str
    """Unique in the plan: joint name and number of the stop combination."""
    joint: int
    """Index of the swept joint, from 0 at the base."""
    stops: tuple[Side, ...]
    """Stop of each resting joint: -1 for the lower, 1 for the upper; 0 for the swept joint."""
    rest: tuple[FiniteFloat, ...]
    """Position (n,) of each resting joint, by the arm file [rad]; the swept joint's entry is its first step."""
    steps: tuple[FiniteFloat, ...]
    """Positions of the swept joint on the way up [rad]; the way down takes them backwards."""
    lever: FiniteFloat
    """Γ/g, lever of gravity on the swept joint, 0 to 1."""
    servo: tuple[bool, ...]
    """Resting joints that are held by their drive's position loop instead of a stop."""
    bias: tuple[FiniteFloat, ...] | None = None
    """Signed torque (n,) that presses each resting joint on its stop [N·m]; None until the scout has been made."""
    speed: Annotated[FiniteFloat | None, Field(gt=0, exclude_if=lambda value: value is None)] = None
    """Speed at which the joint creeps through the steps, which are then the middles of bins [rad/s]; None: at rest."""
    acceleration: FiniteFloat = 1.0
    """Peak acceleration of the swept joint, so that its reaction moves no resting joint off its stop [rad/s²]."""

    @property
    def readings(self) -> int:
        """Number of readings: the steps on the way up and on the way down."""
        return 2 * len(self.steps)

    def target(self, reading: int) -> tuple[float, int]:
        """(position of the swept joint [rad], direction of approach ±1) of one reading, counted from 0."""
        count = len(self.steps)
        return (self.steps[reading], 1) if reading < count else (self.steps[2 * count - 1 - reading], -1)


class SweepPlan(_PlanPart):
    """All sweeps of one pass, tip to base, and the poses that the scout takes first."""

    sweeps: Annotated[tuple[Sweep, ...], Field(min_length=1)]
    scout: tuple[tuple[FiniteFloat, ...], ...]
    """Poses (P, n) at which all joints are servo-held and every sensor is read [rad]."""
    reference_mass: FiniteFloat
    """Mass to attach for the second pass [kg]."""
    standard_error: FiniteFloat
    """Standard error to which each torque reading is averaged, as a share of rated torque."""
    travel_acceleration: FiniteFloat = 1.0
    """Peak acceleration on the way from one sweep to the next [rad/s²]."""
    gain_std: FiniteFloat | None = None
    """Predicted standard deviation of the worst observable torque gain after both passes; None before the scout."""
    notes: tuple[str, ...] = ()
    """Requests that the plan could not meet, one sentence each."""

    @property
    def readings(self) -> int:
        """Static readings of one pass, scout included."""
        return len(self.scout) + sum(sweep.readings for sweep in self.sweeps)
