"""A process that outlives the host of drives which keep on with their last command: `python -m armlink.link.keeper FD`.

The host tells its keeper in every cycle which frames leave its drives safe (`BasicDrives.safe_frames`). When the host
has died, whatever killed it, or has said nothing for some time, the keeper sends them on a bus that it opened itself
before the drives got power. It cannot help where the machine dies, or the cable to the drives.
"""

import contextlib
import math
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence

from armlink.arm_file import LinkSection
from armlink.bus.open import open_link_bus
from armlink.bus.port import Frame, Port
from armlink.channel import Channel, Closed, channel_of, start_process
from armlink.errors import ArmlinkError, BusFault, Refused

START_SECONDS = 20.0
"""Time for a keeper to be there: it imports the package and opens the bus [s]."""
SILENT_PERIODS = 2
"""So many periods beyond `link.deadline` a keeper waits for its host: the host notices its own lateness first."""
SENDINGS, SENDING_PAUSE = 3, 0.01
"""How often the frames are sent, since one may be lost, and the time between [s]."""
END_SECONDS = 2.0
"""Time for a keeper to end when its host closes the arm [s]."""
REMEMBERED_CYCLES = 4
"""So many cycles are the frames of a keeper told from those of another host [cycles]."""
READY = "ready"


class Keeper:
    """The process, as its host sees it."""

    def __init__(self, section: LinkSection, spec: str | None) -> None:
        """Start it on the bus that `spec` names, by default the arm file's. Raises Refused where it cannot keep."""
        self._process, self._channel = start_process(("-m", "armlink.link.keeper"))
        self.lost = self.heard = False
        """Whether it has ended, or reads no more; whether it was heard on the bus."""
        self._told: deque[tuple[Frame, ...]] = deque(maxlen=REMEMBERED_CYCLES)
        told: str | None = None
        self._channel.put((section, spec))
        with contextlib.suppress(Closed):
            self._channel.flush(START_SECONDS)
            told = self._channel.first(START_SECONDS)
        if told != READY:
            self.close()
            why = told or f"it did not start within {START_SECONDS:g} s"
            raise Refused(f"no keeper can watch this host ({why}): the drives would keep on with their last command")

    def renew(self, frames: Sequence[Frame]) -> None:
        """The host lives, and these frames are safe now. Raises BusFault once where the keeper is lost."""
        if self.lost:
            return
        self._told.append(tuple(frames))
        self._channel.put(list(frames))
        try:
            self.lost = not self._channel.flush()
        except Closed:
            self.lost = True
        if self.lost:
            raise BusFault("the keeper of this host has ended: if the host died now, nothing would stop the drives")

    def sends(self, frame: Frame) -> bool:
        """Whether a frame that was heard is the keeper's; it is then noted."""
        own = any(frame in told for told in self._told)
        self.heard = self.heard or own
        return own

    def close(self) -> None:
        """End it. It sends the newest frames once more, which are none for drives without power."""
        self._channel.close()
        try:
            self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def keep(channel: Channel, port: Port, silence: float) -> None:
    """Take frames from a host until it closes the channel or dies; send them then, or `silence` [s] after the last."""
    frames, due, left = list[Frame](), math.inf, 0
    with contextlib.suppress(Closed):
        while True:
            channel.wait(max(due - time.monotonic(), 0.0) if left else None)
            messages = channel.receive()
            if messages:
                frames, due, left = messages[-1], time.monotonic() + silence, SENDINGS
            elif left and time.monotonic() >= due:
                _send(port, frames)
                due, left = time.monotonic() + SENDING_PAUSE, left - 1
    for _ in range(SENDINGS):
        _send(port, frames)
        time.sleep(SENDING_PAUSE)


def _send(port: Port, frames: Sequence[Frame]) -> None:
    with contextlib.suppress(BusFault):  # a bus that is full now may have room the next time
        for can_id, data in frames:
            port.send(can_id, data)


def main(descriptor: int) -> None:
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(each, signal.SIG_IGN)  # it ends with its host
    channel = channel_of(descriptor)
    with contextlib.suppress(Closed):
        section, spec = channel.first()
        try:
            bus = open_link_bus(spec, section)
        except ArmlinkError as error:
            channel.put(str(error))
            channel.flush(END_SECONDS)
            return
        try:
            port = bus.open_port()
            channel.put(READY)
            channel.flush(END_SECONDS)
            keep(channel, port, section.deadline + SILENT_PERIODS / section.rate)
        finally:
            bus.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]))
