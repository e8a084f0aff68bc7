"""pydantic's findings as one line."""

import pytest
from pydantic import BaseModel, ValidationError

from armlink.key_errors import describe


class Pair(BaseModel):
    first: int
    second: int


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"first": 1}, "key second: Field required: add it"),
        ({}, "key first: Field required: add it; 1 more"),
    ],
)
def test_the_first_finding_and_how_many_more(given, says):
    with pytest.raises(ValidationError) as found:
        Pair.model_validate(given)
    assert describe(found.value) == says
