"""Sub-commands of `armlink` that set up an arm."""
