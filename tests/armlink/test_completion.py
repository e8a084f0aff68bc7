"""What may follow in a shell."""

from importlib.metadata import entry_points

import pytest

from armlink.completion import candidates

POINTS = {each.name: each for each in entry_points(group="armlink.commands")}


@pytest.mark.parametrize(
    ("words", "some", "none"),
    [
        ([], ["check", "completion", "--help"], ["sarcos"]),
        (["ch"], ["check"], ["completion", "--help"]),
        (["completion", ""], ["bash", "fish", "zsh"], ["check"]),
        (["check", ""], ["sarcos"], ["--help"]),
        (["check", "--"], ["--help", "--json"], ["sarcos"]),
        (["check", "sarcos", ""], [], ["sarcos"]),
        (["nothing", ""], [], ["sarcos", "check"]),
    ],
)
def test_commands_options_and_arms_each_in_their_place(words, some, none):
    found = candidates(POINTS, words)
    assert set(some) <= set(found)
    assert not set(none) & set(found)
