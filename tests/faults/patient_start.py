"""The start of a link on a busy machine, which may be late with an answer: that is not what is tried here."""

from armlink.errors import ArmlinkError
from armlink.link.link import Link

TRIES = 5


def start(link: Link, late: type[ArmlinkError] = ArmlinkError) -> None:
    """Start the link, again after an error of the kind `late`, TRIES times in all."""
    for attempt in range(TRIES):
        try:
            link.start()
            return
        except late:
            if attempt == TRIES - 1:
                raise
