"""Sub-commands of `armlink` that armlink contributes."""
