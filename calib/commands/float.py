"""Gravity-compensated float: the arm stays where a hand leaves it."""


def hold_afloat() -> None:
    """Being built."""
    raise NotImplementedError
