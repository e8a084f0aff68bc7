"""Checks of mapping, units and clocks, before any effect is fitted."""
