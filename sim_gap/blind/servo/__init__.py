"""Sealed cases of arms with position servos, seen as commanded and measured positions alone."""
