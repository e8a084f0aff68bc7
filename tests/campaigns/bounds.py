"""How a campaign ends: which of its bounds failed."""

from collections.abc import Sequence


def exit_status(wrong: Sequence[str]) -> int:
    """Status of a campaign that found this wrong, a bound each; prints them."""
    for line in wrong:
        print(f"FAILED: {line}")
    print("passed" if not wrong else f"{len(wrong)} bounds failed")
    return int(bool(wrong))
