"""Sub-commands of `armlink` that sim_bus contributes."""
