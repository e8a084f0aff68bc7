"""The referee: one blind benchmark for every tool that fits a simulation model to recordings of an arm."""
