"""From where on a parameter counts as not determined, or its value as of no use (docs/theory.md, sections 7 and 9)."""

# identifiability
NULL_RATIO = 1e-7
"""Share of the largest singular value below which one counts as zero. Structural zeros are below 1e-8, since angles are
written with eight digits; the smallest true ones seen are above 1e-4 (docs/theory.md, section 7.3)."""
NULL_STD = 1.0
"""A direction with a larger standard deviation, in natural units, is held: a linearisation over it means nothing."""
PARTICIPATION = 1e-4
"""Smallest share in a null direction with which a parameter counts as taking part in it."""

# recursion
DEAD_COLUMN = 1e-6
"""Share of g·√K below which a column's norm counts as zero: the axis was along gravity in every row (section 2.3)."""

# global fit
MAX_STD = {"gain": 0.2, "offset": 0.5, "position_gain": 0.1, "position_offset": 0.35, "beta": 0.5, "rho": 0.2}
"""Standard deviation beyond which a value is of no use, per family: as a share of the gain, of the readings' RMS for
offsets, of that over g for mass moments; rad; m (docs/theory.md, section 7.3)."""
DOUBT = 2.0
"""Weighted squares per degree of freedom above which another start is tried (docs/theory.md, section 7.2)."""

# its start
SANE_GAIN_RATIO = 5.0
"""Factor to the start beyond which a gain counts as not determined by its readings (docs/theory.md, section 7.2)."""
FACTORS = (1.0, 0.7, 1.4, 0.5, 2.0, -1.0, -0.7, -1.4, -0.5, -2.0)
"""Common factors tried for such gains: position errors make (L) shrink κ towards zero but keep sign and ratios."""
SMALLEST_RATIO = 1e-2
"""Share of its start below which the sign of a κ is not determined either."""
