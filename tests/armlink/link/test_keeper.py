"""The keeper: when it sends what its host told it, when it does not, and how a host learns of it."""

import os
import pickle
import signal
import socket
import threading
import time
from types import SimpleNamespace

import can
import pytest

from armlink.arm_file import Bus, LinkSection, load_arm
from armlink.bus.port import EXTENDED
from armlink.channel import Channel
from armlink.errors import BusFault, Refused
from armlink.link import keeper
from armlink.link.keeper import Keeper, keep
from armlink.link.link import Link
from sim_bus.bus.lock_step import LockStepBus

LONG = 20.0
"""Longest wait on a busy machine [s]."""
HOLD = [(0x15A, bytes(range(8))), (0x01000005 | EXTENDED, b"\x01")]


class Host:
    """A host's end of the channel, and what its keeper has sent."""

    def __init__(self, silence):
        self.socket, theirs = socket.socketpair()
        self.channel = Channel(self.socket)
        self.sent = []
        port = SimpleNamespace(send=lambda *frame: self.sent.append(frame))
        self.thread = threading.Thread(target=keep, args=(Channel(theirs), port, silence), daemon=True)
        self.thread.start()
        self.keeper = Keeper.__new__(Keeper)
        self.keeper.__dict__.update(_channel=self.channel, lost=False, heard=False, _told=keeper.deque(maxlen=4))

    def renew(self, frames=HOLD):
        self.keeper.renew(frames)

    def until(self, count):
        end = time.monotonic() + LONG
        while len(self.sent) < count and time.monotonic() < end:
            time.sleep(0.005)
        return self.sent

    def dies(self):
        self.channel.close()
        self.thread.join(LONG)


def test_a_host_that_dies_leaves_its_newest_frames():
    host = Host(silence=3600.0)
    host.renew([(1, b"old")])
    host.renew()
    host.dies()
    assert host.sent == HOLD * keeper.SENDINGS


def test_a_host_that_stands_still_is_replaced_until_it_goes_on():
    host = Host(silence=0.05)
    host.renew()
    held = HOLD * keeper.SENDINGS
    assert host.until(len(held)) == held
    host.renew([(2, b"new")])
    assert host.until(len(held) + 1)[len(held)] == (2, b"new")
    host.dies()


def test_a_host_whose_drives_have_no_power_leaves_nothing():
    host = Host(silence=3600.0)
    host.renew()
    host.renew([])
    host.dies()
    assert host.sent == []


def test_a_message_that_came_in_pieces_or_never_whole():
    host = Host(silence=3600.0)
    body = pickle.dumps([(7, b"ab")])
    message = len(body).to_bytes(4, "little") + body
    for byte in message + message[:-1]:
        host.socket.send(bytes([byte]))
        time.sleep(0.001)
    host.dies()
    assert host.sent == [(7, b"ab")] * keeper.SENDINGS


def test_a_keeper_that_ended_is_a_fault_once():
    host = Host(silence=3600.0)
    ours, other = socket.socketpair()
    host.keeper._channel = Channel(ours)
    other.close()
    with pytest.raises(BusFault, match="the keeper of this host has ended"):
        host.renew()
    host.renew()
    host.dies()


def test_its_frames_are_told_from_those_of_another_host():
    host = Host(silence=3600.0)
    host.renew()
    for _ in range(keeper.REMEMBERED_CYCLES - 1):
        host.renew([])
    assert host.keeper.sends(HOLD[1])
    assert host.keeper.heard
    host.renew([])
    assert not host.keeper.sends(HOLD[1])
    host.dies()


GROUP, PORT = "239.74.163.119", 44200 + os.getpid() % 1000  # all groups on one port hear each other


def section():
    bus = Bus(interface="udp_multicast", channel=GROUP, options={"port": PORT})
    link = load_arm("six-piper").require_link()
    return LinkSection.model_validate({**link.model_dump(exclude={"bus"}), "bus": bus.model_dump()})


def test_the_process_sends_on_a_bus_of_its_own_and_no_signal_of_a_terminal_ends_it():
    with can.Bus(interface="udp_multicast", channel=GROUP, port=PORT) as ear:
        kept = Keeper(section(), None)
        kept.renew(HOLD[:1])
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            kept._process.send_signal(each)
        kept._channel.close()  # as the kernel does it for a host that was killed
        heard = ear.recv(LONG)
        assert (heard.arbitration_id, bytes(heard.data)) == HOLD[0]
        assert kept._process.wait(LONG) == 0


def test_without_its_bus_no_power_is_given():
    with pytest.raises(Refused, match=r"no keeper can watch this host .*: the drives would keep on"):
        Keeper(section(), "socketcan:absent0")


def test_an_arm_in_this_process_needs_none():
    with Link(load_arm("six-piper"), LockStepBus("six-piper")) as link:
        link.start()
        link.enable()
        assert link.commander.loop.keeper is None
