"""The end of a process that makes the cycles: it is the job's to begin, and nothing cuts it short but a person."""

import os
import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

from armlink.channel import Channel, Closed
from armlink.link.ends import EndCause
from armlink.loop.messages import End, JobSignal, Told
from armlink.termination import Dropped

GRACE_SECONDS = 2.0
"""After SIGTERM the job has this long to end this process [s]."""
HANG_SECONDS = 10.0
"""A process that takes nothing, answers nothing, or says nothing at the end of its arm, for this time hangs [s]."""
TELL_INTERVAL = 0.2
"""Job and loop hear from each other at least so often [s]."""
OF_A_SERVICE = (signal.SIGTERM, signal.SIGABRT)
"""systemd sends them to every process of a unit: at its stop, and where its watchdog has run out."""
OF_ITS_OWN = (
    signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGCHLD,
    signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE, signal.SIGTRAP, signal.SIGSYS,
)  # fmt: skip
"""Signals that cannot be ignored, that end no process, or that tell of an error of its own."""


class Ending:
    """Signals to a group of processes are left to the job, which is in it: it ends this process, and says how.

    A job that does not within GRACE_SECONDS after SIGTERM hangs, and this process then ends by itself. So it does when
    the job has gone: its end of the channel may live on in a process that the job has forked.
    """

    def __init__(self) -> None:
        """Take over the signals of this process, and leave the terminal."""
        self._asked: float | None = None
        self._job = os.getppid()
        if os.getsid(0) != os.getpid():
            os.setsid()
        for number in signal.valid_signals() - {*OF_A_SERVICE, *OF_ITS_OWN}:
            signal.signal(number, signal.SIG_IGN)
        for number in OF_A_SERVICE:
            signal.signal(number, self._note)

    @property
    def due(self) -> bool:
        """Whether to end although the job is still there."""
        return self._asked is not None and time.monotonic() - self._asked > GRACE_SECONDS

    @property
    def orphaned(self) -> bool:
        return os.getppid() != self._job

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._asked is None:
            self._asked = time.monotonic()


def job_teller(channel: Channel, aside: Callable[[Any], None] = lambda message: None) -> Callable[[str], None]:
    """Tell the job how far the end of its arm is, as long as the job is there; raises Dropped when it says so.

    `aside` takes whatever else the job says meanwhile.
    """

    def tell(text: str) -> None:
        try:
            channel.put(Told(0, text))
            channel.flush()
            messages = channel.receive()
        except Closed:
            return
        for message in messages:
            if message is JobSignal.DROP:
                raise Dropped
            aside(message)

    return tell


def see_out(channel: Channel, runs: Callable[[], bool], cause: EndCause, tell: Callable[[str], None]) -> bool:
    """Have the process at the other end bring its arm to the end, and wait until it has ended; whether it has.

    `tell` is told what it does, and may raise Dropped: the arm is then let go. `runs` tells whether the process runs.
    One that says nothing for HANG_SECONDS hangs. Closes the channel.
    """
    heard, dropped = time.monotonic(), False
    try:
        channel.put(End(cause))
        while runs() and time.monotonic() - heard < HANG_SECONDS:
            channel.flush()
            channel.wait(TELL_INTERVAL)
            try:
                for message in channel.receive():
                    heard = time.monotonic()
                    if isinstance(message, Told) and not message.id:
                        tell(message.text)
                tell("")
            except Dropped:
                if not dropped:
                    channel.put(JobSignal.DROP)
                dropped = True
    except Closed:
        pass
    channel.close()
    while runs() and time.monotonic() - heard < HANG_SECONDS:
        time.sleep(TELL_INTERVAL / 10)
    return not runs()
