"""Sub-commands of `armlink` from sim_bus."""
