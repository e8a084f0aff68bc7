"""Sub-commands of `armlink` that calib contributes."""
