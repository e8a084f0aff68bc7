"""How late a host's cycles began: a histogram that costs the cycle next to nothing, and its percentiles."""

import math
from dataclasses import dataclass, field

UNIT = 1e-5
"""Resolution near zero [s]; further up it is a share of the value, `2 ** (1 / PER_OCTAVE)`."""
PER_OCTAVE = 16
BINS = 24 * PER_OCTAVE
"""The last bin begins at `UNIT * 2**24`, some 170 s."""
WARN_SHARE = 0.5
"""Share of `link.deadline` that the lateness of 99.9 % of the cycles should not exceed."""


@dataclass
class Lateness:
    """Counts of `late` times [s]."""

    counts: list[int] = field(default_factory=lambda: [0] * BINS)
    longest: float = 0.0
    """[s]."""

    def add(self, late: float) -> None:
        """Count one cycle that began `late` [s]; early ones count as on time."""
        if late <= 0.0:
            self.counts[0] += 1
            return
        self.counts[min(int(PER_OCTAVE * math.log2(1.0 + late / UNIT)), BINS - 1)] += 1
        if late > self.longest:
            self.longest = late

    def percentile(self, share: float) -> float:
        """The lateness [s] that this share (0 to 1) of the cycles does not exceed; 0 where none was counted."""
        rest = share * sum(self.counts)
        for index, count in enumerate(self.counts):
            rest -= count
            if rest <= 0 and count:
                return min(float(UNIT * (2.0 ** ((index + 1) / PER_OCTAVE) - 1.0)), self.longest)
        return self.longest

    def near(self, deadline: float, arm: str) -> str:
        """A warning where the host's lateness comes near `link.deadline` [s] of an arm; else empty."""
        late = self.percentile(0.999)
        if late <= WARN_SHARE * deadline:
            return ""
        return (
            f"this host was up to {late * 1e3:.0f} ms late in 99.9 % of the cycles, which comes near "
            f"link.deadline ({deadline * 1e3:.0f} ms): see `armlink check {arm} --host`"
        )

    def in_ms(self) -> dict[str, float]:
        shares = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999}
        return {name: self.percentile(share) * 1e3 for name, share in shares.items()} | {"max": self.longest * 1e3}
