"""Sub-commands of `armlink` that sim_gap contributes."""
