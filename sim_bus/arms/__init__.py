"""Bundled arm files, found by name through the entry-point group `armlink.arms`."""
