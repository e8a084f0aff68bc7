"""The errors that a command turns into one line."""

import pickle

import pytest

from armlink.errors import ArmlinkError, BadInput, BusFault, HostLate


@pytest.mark.parametrize("kind", [ArmlinkError, BadInput, BusFault])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\v", "\f", "\x85", "\u2028"])
def test_a_name_of_several_lines_leaves_the_message_one(kind: type[ArmlinkError], end: str) -> None:
    """Names come from files; the daemon puts messages into its log, status and answers as they are."""
    assert str(kind(f"x.yaml: no joint a{end}b")) == "x.yaml: no joint a b"


def test_what_an_error_says_is_otherwise_its_own_words() -> None:
    assert str(BadInput("two  spaces in a path")) == "two  spaces in a path"
    assert str(BadInput()) == ""
    late = pickle.loads(pickle.dumps(HostLate(0.2, 0.1, "joints\nhold")))
    assert str(late) == "the host was 200 ms late (limit 100 ms); joints hold"
