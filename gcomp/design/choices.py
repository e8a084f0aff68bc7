"""Every choice that the design of sweeps rests on, with its reason."""

# candidate sweeps
MINIMUM_LEVER = 0.3
"""Γ/g of the swept joint below which a combination is used only if none is better (docs/theory.md, section 2.5)."""
SKETCH_STEPS = 7
"""Steps by which a candidate sweep is judged: more than a sinusoid's three unknowns (docs/theory.md, section 5.3)."""

# selection among them
EXCHANGES = 2
"""Rounds in which every selected candidate is compared once more with all others. Further rounds changed 4 of 28
designs (the paper's arm and ten random ones, both criteria)."""
