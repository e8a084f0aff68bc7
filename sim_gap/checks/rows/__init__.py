"""Checks of the rows of a recording: their times, and positions that jump, stand still or are held."""
