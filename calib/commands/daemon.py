"""The long-running service: watches the arm, keeps its torque sensors true, serves a page and an API."""


def daemon() -> None:
    """Being built."""
    raise NotImplementedError
