"""What the families with the MIT law have in common."""

from types import SimpleNamespace

from armlink.drives.base import BROADCAST
from armlink.drives.mit_drives import MitDrives


def test_a_reply_id_that_drives_share_is_told_apart_by_what_is_in_the_reply():
    drives = SimpleNamespace(settings=[SimpleNamespace(reply=reply) for reply in (0x11, 0x12, 0x11, 0x13)])
    assert MitDrives.routes(drives) == {0x11: BROADCAST, 0x12: 1, 0x13: 3}
