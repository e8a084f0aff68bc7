"""Names in an arm file: what goes into file names and reports."""

from typing import Annotated

from pydantic import AfterValidator, Field

Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f/\\]*$")]
"""A name that goes into file names and reports: one line, no path."""


def _no_step(name: str) -> str:
    """The name; raises ValueError where a part of it between slashes is empty or leads out of a folder."""
    if {"", ".", ".."} & set(name.split("/")):
        raise ValueError("on either side of each slash there must be a name, not '.', '..' or nothing")
    return name


JointName = Annotated[
    str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f\\]*$"), AfterValidator(_no_step)
]
"""A joint's name, as its model has it: where models are attached to others, with slashes (`left/elbow`)."""
